// The report of one registration: from the data in the page to its sections.
//
// For tests and scripts, `window.rareReport` has
//   ready           a promise: the page is drawn (also `data-ready="true"` on the root element)
//   viewer          "shown", or "missing" when there is no WebGL
//   setPose(key)    shows the source at the pose with this key
//   blend(value)    shows it between the poses: 0 the first, 1 the second, ...
//   setColour(mode) "cloud", "residual" or "visibility"
//   lookFrom(name)  "fit", "top", "reference" or "source"
//   pullApart(share) moves the source aside, 0 to 1; showSet(index, shown) draws a set of correspondences
//   pixels()        draws and reads back { width, height, data }: RGBA bytes, rows from the bottom

import { cloudColours } from "report/colours";
import { residualHistogram, timingBars } from "report/charts";
import { decodeCloud, decodeMatches } from "report/data";
import { bindThemeButton, copyButton, count, element, fixed, pageData, shortened } from "report/page";
import { SortableTable } from "report/tables";
import { ViewImages } from "report/view-images";

const verdictSigns = { refined: "✓", "kept-initial": "=", rejected: "✕" };
const verdictNames = { refined: "refined", "kept-initial": "initial transform kept", rejected: "rejected" };

function section(id) {
  return document.getElementById(id);
}

function showHeader(data) {
  section("title").replaceChildren(shortened(data.title, 140));
  for (const name of ["source", "reference"]) {
    const swatch = element("i", { class: "swatch", style: `background:${cloudColours[name]}` });
    const entry = element("div", {}, element("dt", {}, swatch, name), element("dd", {}, shortened(data.inputs[name])));
    section("inputs").append(entry);
  }
  section("footer").textContent = `Made by rare ${data.version}. This file holds all it shows and loads nothing.`;
}

function showVerdict(data) {
  const { kind, headline, explanation } = data.verdict;
  const sign = element("span", { class: "sign", text: verdictSigns[kind] ?? "?", role: "img", "aria-label": verdictNames[kind] ?? kind });
  const words = element("div", {}, element("p", { class: "headline", text: headline }), element("p", { class: "explanation", text: explanation }));
  const root = section("verdict");
  root.dataset.kind = kind;
  root.append(element("div", { class: "statement" }, sign, words), numberList(data.numbers), ...warningList(data.warnings));
}

function numberList(numbers) {
  return element("dl", { class: "numbers" }, ...numbers.map(([name, value, meaning]) =>
    element("div", {}, element("dt", { text: name }), element("dd", { class: "value", text: value }), element("dd", { class: "meaning", text: meaning ?? "" }))));
}

function warningList(warnings) {
  if (warnings.length === 0) return [];
  const items = warnings.map((warning) => element("li", { class: "wraps", text: warning }));
  return [element("div", { class: "warnings" }, element("h2", { text: warnings.length === 1 ? "Warning" : "Warnings" }), element("ul", {}, ...items))];
}

function showTransform(data) {
  const blocks = [matrixBlock("Result", data.transform.rows, data.transform.direction, "Copy the transform")];
  if (data.initial) blocks.push(matrixBlock("Initial", data.initial.rows, null, "Copy the initial transform"));
  const command = element("div", { class: "command" }, element("h3", { text: "To reproduce" }), element("pre", { class: "wraps", text: data.command }),
    element("p", { class: "muted", text: `rare ${data.version}; the whole configuration is in the record.` }), copyButton("Copy the command", data.command));
  section("transform").append(...blocks);
  section("transform").after(command);
}

function matrixBlock(name, rows, direction, label) {
  const exact = rows.map((row) => row.join(" ")).join("\n");
  const table = element("table", { class: "matrix" }, element("tbody", {}, ...rows.map((row) =>
    element("tr", {}, ...row.map((value) => element("td", { text: fixed(value, 6) }))))));
  const words = direction ? element("p", { class: "muted", text: capital(direction) }) : null;
  return element("div", { class: "matrix-block" }, element("h3", { text: name }), table, words, copyButton(label, `${exact}\n`));
}

function showSets(sets) {
  const share = (set) => (set.correspondences > 0 ? set.inliers / set.correspondences : null);
  const columns = [
    { key: "label", label: "set", value: (set) => set.label, text: (set) => set.label },
    numberColumn("correspondences", "correspondences", (set) => set.correspondences, count),
    numberColumn("inliers", "inliers", (set) => set.inliers, count),
    numberColumn("share", "inlier share", share, (value) => (value === null ? "–" : `${fixed(100 * value, 1)} %`)),
    numberColumn("residual", "median residual", (set) => set.median_residual, (value) => (value === null ? "–" : `${fixed(value, 3)} m`)),
  ];
  const caption = "Sets of correspondences; inliers and residuals under the resulting transform.";
  section("sets").append(sets.length > 0 ? new SortableTable({ caption, columns, rows: sets, sort: null }).root : nothing("No correspondences were recorded."));
}

function numberColumn(key, label, value, text) {
  return { key, label, numeric: true, descendingFirst: true, value, text: (row) => text(value(row)) };
}

function showMeasures(data) {
  const hasResiduals = data.residuals && data.residuals.counts.length > 0;
  section("residuals").append(hasResiduals ? residualHistogram(data.residuals) : nothing("No residuals were recorded."));
  section("timings").append(data.timings.length > 0 ? timingBars(data.timings) : nothing("No times were recorded."));
}

function showViews(data) {
  if (data.views.length > 0) new ViewImages(section("views"), data.views, data.sets);
  else section("views").append(nothing("No depth maps were recorded."));
}

/** The record's text is made when it is opened: it may be long. */
function showRecord(record) {
  const text = element("pre", { class: "wraps", tabindex: 0, "aria-label": "Record as JSON" });
  const details = element("details", {}, element("summary", { text: "The whole record: configuration, evidence, hypotheses" }), text);
  details.addEventListener("toggle", () => { text.textContent = JSON.stringify(record, null, 2); }, { once: true });
  section("record").append(details);
}

function nothing(text) {
  return element("p", { class: "muted", text });
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** The viewer is loaded apart, so that a browser without WebGL or modules as data still shows the rest. */
async function showViewer(data) {
  const container = section("viewer");
  try {
    const { ViewerPanel } = await import("report/viewer-panel");
    const poseCount = data.scene.poses.length;
    const clouds = {
      reference: decodeCloud(data.scene.clouds.reference, poseCount),
      source: decodeCloud(data.scene.clouds.source, poseCount),
    };
    return new ViewerPanel(container, data, clouds, data.sets.map(decodeMatches));
  } catch (error) {
    container.replaceChildren(element("p", { class: "notice", text: `The three-dimensional view cannot be shown here: ${plainReason(error)} All other parts of this report work without it.` }));
    container.classList.add("without-picture");
    return null;
  }
}

function plainReason(error) {
  const text = String(error?.message ?? error);
  return /webgl/i.test(text) ? "this browser has no WebGL, or it is switched off." : `${text}.`;
}

async function show() {
  const data = pageData();
  let panel = null;
  bindThemeButton(section("theme"), () => panel?.followTheme());
  showHeader(data);
  showVerdict(data);
  showTransform(data);
  showSets(data.sets);
  showMeasures(data);
  showRecord(data.record);
  panel = await showViewer(data);
  panel?.followTheme();
  panel?.viewer.render();
  showViews(data);
  exposeForTests(panel);
  document.documentElement.dataset.ready = "true";
}

function exposeForTests(panel) {
  window.rareReport.viewer = panel ? "shown" : "missing";
  if (!panel) return;
  Object.assign(window.rareReport, {
    setPose: (key) => panel.setPose(key),
    blend: (value) => panel.blend(value),
    setColour: (mode) => panel.setColour(mode),
    lookFrom: (preset) => panel.viewer.lookFrom(preset),
    pullApart: (share) => panel.pullApart(share),
    showSet: (index, shown) => panel.showSet(index, shown),
    pixels: () => panel.viewer.pixels(),
  });
}

window.rareReport = {};
window.rareReport.ready = show();
