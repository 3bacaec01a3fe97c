// The depth maps of each view, and the matches drawn between the two maps of a view.

import { matchColours, viridisGradient, visibilityKinds } from "report/colours";
import { svg } from "report/charts";
import { checkbox, count, element, metres, slider } from "report/page";

const mapKinds = [
  ["sparse", "raw depth"],
  ["dense", "densified depth"],
  ["features", "features (three principal components)"],
];
const matchGap = 12;

/** All views, or one at a time with a selector when there are more than two. */
export class ViewImages {
  constructor(container, views, sets) {
    this.views = views;
    this.sets = sets;
    this.shown = { inlier: true, outlier: true, most: 200, sets: sets.map(() => true) };
    this.frame = element("div");
    this.enlarged = makeDialog();
    if (views.length > 2) container.append(this.makeSelector());
    container.append(maskLegend(), this.makeMatchControls(), this.frame, this.enlarged.root);
    this.drawn = [];
    this.show(views.length > 2 ? [0] : views.map((_, index) => index));
  }

  makeSelector() {
    const options = this.views.map((view, index) => element("option", { value: index, text: `${index + 1}. ${view.name}` }));
    const select = element("select", { on: { change: () => this.show([Number(select.value)]) } }, ...options);
    return element("label", { class: "selector" }, element("span", { text: "View" }), select);
  }

  makeMatchControls() {
    const kinds = [["inlier", "inliers"], ["outlier", "outliers (dashed)"]].map(([kind, label]) =>
      checkbox(label, true, (shown) => this.change(() => { this.shown[kind] = shown; }), { swatch: matchColours[kind] }).root);
    const sets = this.sets.map((set, index) =>
      checkbox(set.label, true, (shown) => this.change(() => { this.shown.sets[index] = shown; })).root);
    const most = slider("Lines in a view, at most", { low: 20, high: 1000, step: 20, value: this.shown.most }, (value) => this.change(() => { this.shown.most = value; }));
    return element("fieldset", { class: "match-controls" }, element("legend", { text: "Matches shown" }), ...kinds, ...sets, most.root);
  }

  change(apply) {
    apply();
    for (const { view, overlay, caption } of this.drawn) this.drawMatches(view, overlay, caption);
  }

  show(indices) {
    this.drawn = [];
    this.frame.replaceChildren(...indices.map((index) => this.viewBlock(this.views[index])));
  }

  viewBlock(view) {
    const heading = element("h3", { text: capital(view.name) });
    return element("article", { class: "view" }, heading, this.mapGrid(view), depthLegend(view.depth_range), this.matchFigure(view));
  }

  // ---- maps

  /** A row for each cloud: raw, densified, features, and in the last column the agreement under a pose. */
  mapGrid(view) {
    const grid = element("div", { class: "map-grid" });
    ["reference", "source"].forEach((cloud, row) => {
      for (const [key, name] of mapKinds) grid.append(this.map(view[cloud]?.[key], `${capital(cloud)}: ${name}`, view));
      const mask = view.masks[row];
      grid.append(mask ? this.map(mask.image, `Agreement, ${mask.name}`, view) : element("div"));
    });
    for (const mask of view.masks.slice(2)) grid.append(this.map(mask.image, `Agreement, ${mask.name}`, view));
    return grid;
  }

  map(address, name, view) {
    const caption = element("figcaption", { text: name });
    if (!address) return element("figure", { class: "map" }, element("div", { class: "missing", style: `aspect-ratio:${view.width}/${view.height}`, text: "not made" }), caption);
    const image = element("img", { src: address, alt: `${name}, ${view.name}`, width: view.width, height: view.height });
    const button = element("button", { type: "button", class: "map-button", title: "Enlarge", on: { click: () => this.enlarged.open(address, `${name}, ${view.name}`) } }, image);
    return element("figure", { class: "map" }, button, caption);
  }

  // ---- matches

  matchFigure(view) {
    const { width, height } = view;
    const image = (cloud, at) => svg("image", { href: view[cloud]?.dense ?? "", x: at, y: 0, width, height, preserveAspectRatio: "none" });
    const overlay = svg("g", { class: "match-lines" });
    const whole = 2 * width + matchGap;
    const picture = svg("svg", { viewBox: `0 0 ${whole} ${height}`, class: "matches", role: "img", "aria-label": `Matches between the depth maps of the ${view.name}` }, image("source", 0), image("reference", width + matchGap), overlay);
    const caption = element("figcaption");
    this.drawn.push({ view, overlay, caption });
    this.drawMatches(view, overlay, caption);
    const names = element("div", { class: "match-names" }, element("span", { text: "source" }), element("span", { text: "reference" }));
    return element("figure", { class: "match-figure" }, names, picture, caption);
  }

  drawMatches(view, overlay, caption) {
    const allowed = view.matches.filter((match) => this.shown[match[4] ? "inlier" : "outlier"] && (this.shown.sets[match[5]] ?? true));
    const chosen = evenly(allowed, this.shown.most);
    // Outliers first, so that the inliers are drawn over them.
    overlay.replaceChildren(...["outlier", "inlier"].map((kind) => linePath(chosen.filter((match) => Boolean(match[4]) === (kind === "inlier")), view.width + matchGap, kind)));
    caption.textContent = matchText(view.matches, chosen.length);
  }
}

function linePath(matches, shift, kind) {
  const lines = matches.map(([us, vs, ur, vr]) => `M${us} ${vs}L${ur + shift} ${vr}`).join("");
  return svg("path", { d: lines, class: `match ${kind}`, stroke: matchColours[kind] });
}

/** At most `most` of the items, spread evenly over all of them. */
function evenly(items, most) {
  if (items.length <= most) return items;
  return Array.from({ length: most }, (_, index) => items[Math.floor((index * items.length) / most)]);
}

function matchText(matches, shown) {
  const inliers = matches.filter((match) => match[4]).length;
  return `${count(shown)} of ${count(matches.length)} matches drawn; ${count(inliers)} of all are inliers.`;
}

function maskLegend() {
  const entries = visibilityKinds.slice(1).map((kind) => element("span", { class: "legend-entry", title: kind.meaning },
    element("i", { class: "swatch", style: `background:${kind.colour}` }), element("span", { text: `${kind.name}: ${kind.meaning}` })));
  return element("p", { class: "mask-legend" }, element("span", { text: "Agreement: " }), ...entries);
}

function depthLegend(range) {
  if (!range) return element("p", { class: "depth-legend", text: "Neither cloud is seen in this view." });
  const [near, far] = range;
  const bar = element("span", { class: "ramp", style: `background:${viridisGradient("left")}` });
  return element("p", { class: "depth-legend" }, element("span", { text: `Depth ${metres(near)}` }), bar, element("span", { text: metres(far) }));
}

function makeDialog() {
  const image = element("img", { alt: "" });
  const caption = element("p");
  const close = element("button", { type: "button", text: "Close", on: { click: () => root.close() } });
  const root = element("dialog", { class: "enlarged", "aria-label": "Enlarged map", on: { click: (event) => { if (event.target === root) root.close(); } } }, image, element("div", { class: "inline" }, caption, close));
  const open = (address, name) => {
    image.src = address;
    image.alt = name;
    caption.textContent = name;
    root.showModal();
  };
  return { root, open };
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
