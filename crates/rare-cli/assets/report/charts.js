// Charts as SVG, which prints sharply and needs no library.

import { element, fixed } from "report/page";

const namespace = "http://www.w3.org/2000/svg";

/** An SVG element with attributes; `text` becomes its text. */
export function svg(tag, options = {}, ...children) {
  const made = document.createElementNS(namespace, tag);
  for (const [name, value] of Object.entries(options)) {
    if (name === "text") made.textContent = value;
    else if (value !== null && value !== undefined) made.setAttribute(name, String(value));
  }
  made.append(...children);
  return made;
}

const frame = { width: 560, height: 260, left: 46, right: 14, top: 28, bottom: 40 };

/** Round numbers from 0 to `end`, about `wanted` of them. */
export function ticksTo(end, wanted = 5) {
  const rough = end / wanted;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough * 0.999);
  const ticks = [];
  for (let index = 0; index * step <= end * 1.0001; index += 1) ticks.push(Number((index * step).toPrecision(6)));
  return ticks;
}

/** Axes from 0 to `xEnd` and `yEnd`, and functions from values to places. */
function axes({ xEnd, yEnd, xLabel, yLabel }) {
  const x = (value) => frame.left + (value / xEnd) * (frame.width - frame.left - frame.right);
  const y = (value) => frame.height - frame.bottom - (value / yEnd) * (frame.height - frame.top - frame.bottom);
  const group = svg("g", { class: "axes" });
  for (const tick of ticksTo(yEnd, 4)) {
    group.append(svg("line", { x1: x(0), x2: x(xEnd), y1: y(tick), y2: y(tick), class: "grid" }));
    group.append(svg("text", { x: frame.left - 7, y: y(tick) + 4, "text-anchor": "end", text: tick }));
  }
  for (const tick of ticksTo(xEnd)) {
    group.append(svg("text", { x: x(tick), y: frame.height - frame.bottom + 17, "text-anchor": "middle", text: tick }));
  }
  group.append(svg("line", { x1: x(0), x2: x(xEnd), y1: y(0), y2: y(0), class: "base" }));
  group.append(svg("text", { x: x(xEnd), y: frame.height - 5, "text-anchor": "end", class: "axis-label", text: xLabel }));
  group.append(svg("text", { x: 4, y: 13, class: "axis-label", text: yLabel }));
  return { x, y, group };
}

function chart(label, ...children) {
  return svg("svg", { viewBox: `0 0 ${frame.width} ${frame.height}`, class: "chart", role: "img", "aria-label": label }, ...children);
}

/** Curves. `series`: `{ name, points, colour, dash }`; `mark`: an x value with a dotted line and a word. */
export function curves({ label, xEnd, yEnd, xLabel, yLabel, series, mark }) {
  const { x, y, group } = axes({ xEnd, yEnd, xLabel, yLabel });
  const paths = series.map(({ name, points, colour, dash }) => {
    const inside = points.filter(([at]) => at <= xEnd * 1.0001);
    const line = inside.map(([at, value], index) => `${index ? "L" : "M"}${x(at).toFixed(1)} ${y(value).toFixed(1)}`).join("");
    return svg("path", { d: line, class: "curve", stroke: colour, "stroke-dasharray": dash }, svg("title", { text: name }));
  });
  const marks = mark && mark.at <= xEnd ? markAt(x(mark.at), mark.text) : [];
  return chart(label, group, ...marks, ...paths);
}

function markAt(place, text) {
  const bottom = frame.height - frame.bottom;
  return [
    svg("line", { x1: place, x2: place, y1: frame.top, y2: bottom, class: "mark" }),
    svg("text", { x: place - 5, y: bottom - 6, "text-anchor": "end", class: "axis-label", text }),
  ];
}

/** The legend of curves, as a list. */
export function curveLegend(series) {
  return element("ul", { class: "curve-legend" }, ...series.map(({ name, colour, dash, note }) => {
    const line = svg("line", { x1: 0, x2: 30, y1: 5, y2: 5, class: "curve", stroke: colour, "stroke-dasharray": dash });
    const sample = svg("svg", { viewBox: "0 0 30 10", width: 30, height: 10, "aria-hidden": "true" }, line);
    return element("li", {}, sample, element("span", { class: "wraps", text: name }), note ? element("span", { class: "muted", text: note }) : null);
  }));
}

/** Histograms of residuals as shares of all points: the last drawn with an ink line, those before it as grey areas. */
export function residualHistogram({ end, counts }) {
  const shares = counts.map(sharesOf);
  const yEnd = niceEnd(Math.max(...shares.flatMap((each) => each.bins), 1));
  const { x, y, group } = axes({ xEnd: end, yEnd, xLabel: "distance to the other cloud, metres", yLabel: "% of points" });
  const steps = shares.map((each, index) => {
    const kind = index === shares.length - 1 ? "step result" : "step before";
    return svg("path", { d: stepPath(each.bins, end, x, y), class: kind });
  });
  const label = `Histogram of residuals up to ${end} metres: ${shares.map((each) => `${each.name} ${fixed(each.beyond, 1)} % beyond`).join(", ")}`;
  return element("div", {}, chart(label, group, ...steps), histogramLegend(shares, end));
}

function sharesOf({ name, counts, beyond }) {
  const total = Math.max(counts.reduce((sum, value) => sum + value, beyond), 1);
  return { name, bins: counts.map((value) => (100 * value) / total), beyond: (100 * beyond) / total };
}

function niceEnd(value) {
  const ticks = ticksTo(value, 4);
  const last = ticks[ticks.length - 1];
  return last >= value ? last : last + (ticks[1] - ticks[0]);
}

function stepPath(bins, end, x, y) {
  const width = end / bins.length;
  const steps = bins.map((value, index) => `L${x(index * width).toFixed(1)} ${y(value).toFixed(1)}L${x((index + 1) * width).toFixed(1)} ${y(value).toFixed(1)}`);
  return `M${x(0)} ${y(0)}${steps.join("")}L${x(end)} ${y(0)}Z`;
}

function histogramLegend(shares, end) {
  return element("ul", { class: "curve-legend" }, ...shares.map((each, index) => {
    const kind = index === shares.length - 1 ? "step result" : "step before";
    const sample = svg("svg", { viewBox: "0 0 22 12", width: 22, height: 12, "aria-hidden": "true" }, svg("rect", { x: 1, y: 1, width: 20, height: 10, class: kind }));
    const note = `${fixed(each.beyond, 1)} % beyond ${end} m`;
    return element("li", {}, sample, element("span", { text: each.name }), element("span", { class: "muted", text: note }));
  }));
}

/** Seconds per stage as a table with bars. */
export function timingBars(timings) {
  const longest = Math.max(...timings.map(([, seconds]) => seconds), 1e-9);
  const total = timings.reduce((sum, [, seconds]) => sum + seconds, 0);
  const rows = timings.map(([stage, seconds]) => {
    const bar = element("div", { class: "bar", style: `width:${((100 * seconds) / longest).toFixed(2)}%` });
    return element("tr", {}, element("th", { scope: "row", text: stage }), element("td", { class: "bar-cell" }, bar), element("td", { class: "number", text: `${fixed(seconds, 3)} s` }));
  });
  const sum = element("tr", { class: "total" }, element("th", { scope: "row", text: "together" }), element("td"), element("td", { class: "number", text: `${fixed(total, 3)} s` }));
  return element("table", { class: "timings" }, element("tbody", {}, ...rows, sum));
}
