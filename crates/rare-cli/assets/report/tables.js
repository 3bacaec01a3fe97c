// Tables that sort by their column heads.

import { element } from "report/page";

/**
 * A sortable table. `columns`: `{ key, label, title, numeric, value(row), text(row), cell(row) }`, where `value` is what
 * is sorted by, and `cell` gives an element in place of plain `text`. Rows without a value stay last in both directions.
 * `most` rows are drawn; a button draws the rest.
 */
export class SortableTable {
  constructor({ caption, columns, rows, sort, most = Infinity }) {
    this.columns = columns;
    this.rows = rows;
    this.sort = sort;
    this.most = most;
    this.heads = columns.map((column) => this.makeHead(column));
    this.body = element("tbody");
    const head = element("thead", {}, element("tr", {}, ...this.heads));
    const table = element("table", {}, element("caption", { text: caption }), head, this.body);
    this.more = element("button", { type: "button", class: "more", hidden: true, on: { click: () => this.showAll() } });
    this.root = element("div", {}, element("div", { class: "table-frame" }, table), this.more);
    this.draw();
  }

  makeHead(column) {
    const button = element("button", { type: "button", title: column.title, on: { click: () => this.sortBy(column) } }, element("span", { text: column.label }), element("span", { class: "arrow", "aria-hidden": "true" }));
    return element("th", { scope: "col", class: column.numeric ? "number" : null }, button);
  }

  sortBy(column) {
    const same = this.sort?.key === column.key;
    this.sort = { key: column.key, descending: same ? !this.sort.descending : Boolean(column.descendingFirst) };
    this.draw();
  }

  setRows(rows) {
    this.rows = rows;
    this.draw();
  }

  showAll() {
    this.most = Infinity;
    this.draw();
  }

  draw() {
    this.columns.forEach((column, index) => {
      const chosen = this.sort?.key === column.key;
      const direction = this.sort?.descending ? "descending" : "ascending";
      this.heads[index].setAttribute("aria-sort", chosen ? direction : "none");
      this.heads[index].querySelector(".arrow").textContent = chosen ? (this.sort.descending ? "▼" : "▲") : "";
    });
    const sorted = this.sorted();
    this.body.replaceChildren(...sorted.slice(0, this.most).map((row) => this.rowElement(row)));
    this.more.hidden = sorted.length <= this.most;
    this.more.textContent = `Show all ${sorted.length} rows (${Math.min(this.most, sorted.length)} are shown)`;
  }

  sorted() {
    const column = this.columns.find(({ key }) => key === this.sort?.key);
    if (!column) return this.rows;
    const sign = this.sort.descending ? -1 : 1;
    return [...this.rows].sort((a, b) => compare(column.value(a), column.value(b), sign));
  }

  rowElement(row) {
    return element("tr", {}, ...this.columns.map((column) => {
      const content = column.cell ? column.cell(row) : null;
      return element("td", { class: column.numeric ? "number" : null, text: content ? null : column.text(row) }, content);
    }));
  }
}

function compare(a, b, sign) {
  const missing = (value) => value === null || value === undefined || Number.isNaN(value);
  if (missing(a) || missing(b)) return Number(missing(a)) - Number(missing(b));
  if (typeof a === "number" && typeof b === "number") return sign * (a - b);
  return sign * String(a).localeCompare(String(b), "en", { numeric: true });
}
