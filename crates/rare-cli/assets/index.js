// The index page of an evaluation: methods, recall curves, and the table of pairs.
//
// For tests, `data-ready="true"` on the root element says that the page is drawn.

import { curveLegend, curves } from "report/charts";
import { curveColours, curveDashes } from "report/colours";
import { bindThemeButton, checkbox, count, element, fixed, pageData, shortened } from "report/page";
import { SortableTable } from "report/tables";

const rowsAtFirst = 500;
const verdictNames = { refined: "refined", "kept-initial": "initial kept", rejected: "rejected" };

function section(id) {
  return document.getElementById(id);
}

/** How bad a pair is: errors before unsolved pairs before solved ones, then by the error as a share of its limit. */
function badness(pair, limits) {
  if (pair.error) return 2e12;
  const rotation = pair.rotation === null ? 0 : pair.rotation / limits.rotation;
  const translation = pair.translation === null ? 0 : pair.translation / limits.translation;
  const share = pair.rotation === null && pair.translation === null ? 1e9 : Math.max(rotation, translation);
  return Math.min(share, 1e9) + (pair.solved === true ? 0 : 1e12);
}

function numberColumn(key, label, decimals, title) {
  return { key, label, title, numeric: true, descendingFirst: true, value: (row) => row[key], text: (row) => fixed(row[key], decimals) };
}

function textColumn(key, label) {
  return { key, label, value: (row) => row[key], text: (row) => String(row[key] ?? "–"), cell: (row) => shortened(row[key] ?? "–", 60) };
}

function showHeader(data) {
  section("title").replaceChildren(shortened(data.title, 140));
  section("success").textContent = `A pair is solved when its rotation is off by less than ${data.success.rotation}° and its translation by less than ${data.success.translation} m.`;
  section("footer").textContent = `Made by rare ${data.version}. This file loads nothing; the pages of pairs lie beside it.`;
}

function showMethods(data) {
  const share = (method) => (method.pairs > 0 ? (100 * method.solved) / method.pairs : null);
  const columns = [
    textColumn("name", "method"),
    numberColumn("pairs", "pairs", 0),
    numberColumn("solved", "solved", 0),
    { ...numberColumn("share", "solved (%)", 1), value: share, text: (method) => fixed(share(method), 1) },
    numberColumn("mean_rotation", "mean rotation (°)", 2),
    numberColumn("mean_translation", "mean translation (m)", 3),
  ];
  const table = new SortableTable({ caption: "Mean errors are over the pairs with a measured error.", columns, rows: data.methods, sort: null });
  section("methods").append(table.root);
}

function showRecall(data) {
  const series = (key) => data.methods.map((method, index) => ({
    name: method.name,
    points: method[key] ?? [],
    colour: curveColours[index % curveColours.length],
    dash: curveDashes[Math.floor(index / curveColours.length + index) % curveDashes.length],
  }));
  const figure = (key, unit, limit, what) => {
    const lines = series(key);
    const xEnd = Math.max(limit, ...lines.flatMap(({ points }) => points.map(([at]) => at)));
    const picture = curves({ label: `Share of pairs by ${what} error`, xEnd, yEnd: 100, xLabel: `${what} error, ${unit}`, yLabel: "% of pairs", series: lines, mark: { at: limit, text: "limit" } });
    return element("figure", {}, element("figcaption", { text: `Pairs with a smaller ${what} error` }), picture);
  };
  const figures = element("div", { class: "columns" },
    figure("recall_rotation", "degrees", data.success.rotation, "rotation"),
    figure("recall_translation", "metres", data.success.translation, "translation"));
  section("recall").append(figures, curveLegend(series("recall_rotation")));
}

// ---- pairs

function pairColumns(limits) {
  return [
    { key: "result", label: "result", title: "sort worst first", descendingFirst: true, value: (pair) => badness(pair, limits), text: resultText, cell: resultCell },
    textColumn("method", "method"),
    textColumn("scene", "scene"),
    { key: "pair", label: "source → reference", value: pairName, text: pairName, cell: pairCell },
    numberColumn("rotation", "rotation (°)", 2, "rotation error"),
    numberColumn("translation", "translation (m)", 3, "translation error"),
    { ...numberColumn("overlap", "overlap (%)", 1), text: (pair) => fixed(percent(pair.overlap), 1) },
    numberColumn("confidence", "confidence", 3),
    { ...textColumn("verdict", "verdict"), text: (pair) => verdictNames[pair.verdict] ?? pair.verdict ?? "–", cell: null },
    numberColumn("seconds", "seconds", 2),
  ];
}

function percent(share) {
  return Number.isFinite(share) ? 100 * share : NaN;
}

function pairName(pair) {
  return `${pair.source} → ${pair.reference}`;
}

function pairCell(pair) {
  const name = shortened(pairName(pair), 60);
  return pair.page ? element("a", { href: pair.page }, name) : name;
}

function resultText(pair) {
  if (pair.error) return "error";
  return pair.solved === true ? "solved" : "not solved";
}

function resultCell(pair) {
  const text = resultText(pair);
  const sign = { solved: "✓", "not solved": "✕", error: "!" }[text];
  const badge = element("span", { class: `badge ${text.replace(" ", "-")}` }, element("span", { "aria-hidden": "true", text: sign }), ` ${text}`);
  return pair.error ? element("div", {}, badge, element("div", { class: "error-text" }, shortened(pair.error, 120))) : badge;
}

class PairBrowser {
  constructor(container, data) {
    this.pairs = data.pairs;
    this.filter = { method: "", scene: "", text: "", failures: false };
    this.status = element("p", { class: "muted", role: "status" });
    const columns = pairColumns(data.success);
    this.table = new SortableTable({ caption: "Worst first: errors, then pairs that are not solved, then by their error as a share of the limit.", columns, rows: this.pairs, sort: { key: "result", descending: true }, most: rowsAtFirst });
    container.append(this.makeFilters(), this.status, this.table.root);
    this.apply();
  }

  makeFilters() {
    const search = element("input", { type: "search", id: "filter-text", placeholder: "name of a scene or cloud", on: { input: () => this.change("text", search.value.toLowerCase()) } });
    const failures = checkbox("only failures", false, (checked) => this.change("failures", checked));
    failures.input.id = "filter-failures";
    return element("div", { class: "filters", role: "search" }, this.selector("method"), this.selector("scene"),
      element("label", { class: "selector" }, element("span", { text: "Text" }), search), failures.root);
  }

  selector(key) {
    const values = [...new Set(this.pairs.map((pair) => pair[key]))].sort((a, b) => String(a).localeCompare(String(b), "en", { numeric: true }));
    const options = values.map((value) => element("option", { value, text: value }));
    const select = element("select", { id: `filter-${key}`, on: { change: () => this.change(key, select.value) } }, element("option", { value: "", text: "all" }), ...options);
    return element("label", { class: "selector" }, element("span", { text: key === "method" ? "Method" : "Scene" }), select);
  }

  change(key, value) {
    this.filter[key] = value;
    this.apply();
  }

  apply() {
    const chosen = this.pairs.filter((pair) => this.accepts(pair));
    this.table.setRows(chosen);
    this.status.textContent = `${count(chosen.length)} of ${count(this.pairs.length)} pairs`;
  }

  accepts(pair) {
    const { method, scene, text, failures } = this.filter;
    if (method && pair.method !== method) return false;
    if (scene && pair.scene !== scene) return false;
    if (failures && pair.solved === true && !pair.error) return false;
    return !text || `${pair.method} ${pair.scene} ${pairName(pair)} ${pair.error ?? ""}`.toLowerCase().includes(text);
  }
}

function show() {
  const data = pageData();
  bindThemeButton(section("theme"));
  showHeader(data);
  showMethods(data);
  showRecall(data);
  new PairBrowser(section("pairs"), data);
  document.documentElement.dataset.ready = "true";
}

show();
