// The colours of the report: Okabe and Ito's palette and viridis, which colour-blind people can tell apart, too.

export const cloudColours = { reference: "#0072b2", source: "#e69f00" };
export const matchColours = { inlier: "#009e73", outlier: "#d55e00" };

/** Visibility codes of the data, in order; the masks of the depth maps use the same colours. */
export const visibilityKinds = [
  { name: "not seen", colour: "#b4b4b4", meaning: "the other sensor did not look there" },
  { name: "agree", colour: "#009e73", meaning: "both scans see the same surface" },
  { name: "occluded", colour: "#56b4e9", meaning: "behind a surface of the other scan" },
  { name: "free-space violation", colour: "#d55e00", meaning: "in space that the other scan saw to be empty" },
];

/** Points without a partner within the end of the residual scale. */
export const beyondColour = "#b4b4b4";

/** Colours and dashes of curves, for any number of methods. */
export const curveColours = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f"];
export const curveDashes = ["", "7 3", "2 3", "9 3 2 3"];

const viridisStops = [
  "#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725",
];

/** Red, green and blue (0 to 255) of "#rrggbb". */
export function bytesOf(hex) {
  return [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16));
}

/** Viridis at 0 to 1, as bytes. */
export function viridis(value) {
  const place = Math.min(Math.max(value, 0), 1) * (viridisStops.length - 1);
  const before = Math.min(Math.floor(place), viridisStops.length - 2);
  const [low, high] = [bytesOf(viridisStops[before]), bytesOf(viridisStops[before + 1])];
  return low.map((channel, index) => Math.round(channel + (high[index] - channel) * (place - before)));
}

/** Viridis as a CSS gradient that grows towards a side. */
export function viridisGradient(side = "right") {
  return `linear-gradient(to ${side}, ${viridisStops.join(", ")})`;
}

/** 256 RGBA entries: residual bytes to colours. */
export function residualPalette() {
  return palette((byte) => (byte === 255 ? bytesOf(beyondColour) : viridis(byte / 254)));
}

/** 256 RGBA entries: visibility codes to colours. */
export function visibilityPalette() {
  return palette((byte) => bytesOf((visibilityKinds[byte] ?? visibilityKinds[0]).colour));
}

function palette(colourOf) {
  const entries = new Uint8Array(256 * 4);
  for (let byte = 0; byte < 256; byte += 1) entries.set([...colourOf(byte), 255], byte * 4);
  return entries;
}
