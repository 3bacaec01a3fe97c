// The controls beside the picture, its legend, and its keys.

import { beyondColour, cloudColours, matchColours, viridisGradient, visibilityKinds } from "report/colours";
import { checkbox, choiceBar, count, element, metres, slider } from "report/page";
import { Viewer, colourModes } from "report/viewer";

const modeNames = { cloud: "cloud", residual: "residual", visibility: "visibility" };
const presets = [
  ["fit", "Everything", "f"],
  ["top", "From above", "u"],
  ["reference", "Reference view", "r"],
  ["source", "Source view", "s"],
];
const keysHelp = [
  ["t", "initial / refined, by turns"],
  ["1 2 3", "poses in order"],
  ["c", "next colouring"],
  ["b, o", "reference (blue), source (orange) on or off"],
  ["l", "correspondences on or off"],
  ["+ −", "larger, smaller points"],
  ["f u r s", "everything, from above, reference view, source view"],
  ["arrows", "turn; with Shift: move (picture focused)"],
  ["Page up, Page down", "nearer, farther (picture focused)"],
  ["mouse", "drag: turn; right button: move; wheel, after a click: nearer"],
];

/** Picture and controls, in `container`. Throws when there is no WebGL. */
export class ViewerPanel {
  constructor(container, data, clouds, matches) {
    this.poses = data.scene.poses;
    this.scene = data.scene;
    this.picture = element("div", { class: "picture" });
    this.panel = element("div", { class: "panel" });
    container.append(this.picture, this.panel);
    this.viewer = new Viewer(this.picture, data.scene, clouds, matches);
    this.describePicture();
    this.panel.append(
      this.makePoseControls(), this.makeColourControls(), this.makeCloudControls(),
      this.makeViewControls(), this.makeSetControls(data.sets), this.makeSaveButton(), this.makeKeysHelp(),
    );
    this.legend = element("div", { class: "legend" });
    this.caption = element("p", { class: "pose-caption", role: "status" });
    this.picture.append(this.legend, this.caption);
    this.setPose(this.poses[this.poses.length - 1].key);
    this.setColour("cloud");
    this.bindKeys(container);
    this.bindPrinting();
  }

  // ---- making

  describePicture() {
    const { canvas } = this.viewer;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application"); // it takes the arrow keys
    canvas.setAttribute("aria-label", "Source (orange) and reference (blue) in three dimensions; keys are listed under Keys");
    canvas.addEventListener("pointerdown", () => { canvas.focus({ preventScroll: true }); });
    canvas.addEventListener("focus", () => this.viewer.setZooming(true));
    canvas.addEventListener("blur", () => this.viewer.setZooming(false));
    canvas.addEventListener("webglcontextlost", () => { this.caption.textContent = "The graphics card was lost; waiting for it"; });
    canvas.addEventListener("webglcontextrestored", () => { this.describePose(); this.viewer.requestRender(); });
  }

  makePoseControls() {
    const choices = this.poses.map((pose, index) => [pose.key, pose.name, `key ${index + 1}`]);
    const last = this.poses.length - 1;
    this.poseBar = choiceBar("Pose of the source", "pose", choices, this.poses[last].key, (key) => this.setPose(key));
    this.poseSlider = slider("Blend between poses", { low: 0, high: last, step: 0.01, value: last, describe: (value) => this.poseText(value) }, (value) => this.blend(value));
    this.apartSlider = slider("Pull clouds apart", { low: 0, high: 1, step: 0.01, value: 0 }, (value) => this.pullApart(value));
    this.poseSlider.root.classList.add("full");
    return element("div", { class: "group" }, this.poseBar.root, this.poseSlider.root, this.apartSlider.root);
  }

  makeColourControls() {
    const choices = colourModes.map((mode) => [mode, modeNames[mode]]);
    this.colourBar = choiceBar("Colour by", "colour", choices, "cloud", (mode) => this.setColour(mode));
    return element("div", { class: "group" }, this.colourBar.root);
  }

  makeCloudControls() {
    this.cloudBoxes = {};
    const rows = ["source", "reference"].map((name) => {
      const box = checkbox(name, true, (shown) => this.viewer.setCloudShown(name, shown), { swatch: cloudColours[name], note: shownPoints(this.scene.clouds[name]) });
      this.cloudBoxes[name] = box.input;
      return box.root;
    });
    this.sizeSlider = slider("Point size", { low: -2, high: 2, step: 0.25, value: 0 }, (value) => this.viewer.setPointScale(2 ** value));
    const legend = element("legend", { text: "Clouds, points shown" });
    return element("div", { class: "group" }, element("fieldset", {}, legend, ...rows), this.sizeSlider.root);
  }

  makeViewControls() {
    const buttons = presets.map(([preset, label, key]) => element("button", {
      type: "button", text: label, title: `key ${key}`, on: { click: () => this.viewer.lookFrom(preset) },
    }));
    const legend = element("legend", { text: "Look from" });
    return element("fieldset", { class: "group buttons" }, legend, ...buttons);
  }

  makeSetControls(sets) {
    const legend = element("legend", { text: "Correspondences" });
    this.setBoxes = sets.map((set, index) => checkbox(set.label, false, (shown) => this.viewer.setSetShown(index, shown), { note: count(set.shown) }));
    const kinds = [["inlier", "inliers"], ["outlier", "outliers (dashed)"]].map(([kind, label]) =>
      checkbox(label, true, (shown) => this.viewer.setKindShown(kind, shown), { swatch: matchColours[kind] }).root);
    if (sets.length === 0) return element("p", { class: "muted", text: "No correspondences were recorded." });
    const kindRow = element("div", { class: "inline" }, ...kinds);
    return element("fieldset", { class: "group" }, legend, ...this.setBoxes.map((box) => box.root), kindRow);
  }

  makeSaveButton() {
    return element("button", { type: "button", text: "Save picture as PNG", on: { click: () => this.savePicture() } });
  }

  makeKeysHelp() {
    const list = element("dl", { class: "keys" });
    for (const [keys, meaning] of keysHelp) list.append(element("dt", { text: keys }), element("dd", { text: meaning }));
    this.keysDetails = element("details", { class: "group" }, element("summary", { text: "Keys" }), list);
    return this.keysDetails;
  }

  // ---- what the controls, the keys and the tests do

  setPose(key) {
    const index = this.poses.findIndex((pose) => pose.key === key);
    if (index < 0) throw new Error(`no pose ${key}`);
    this.blend(index);
  }

  blend(value) {
    this.viewer.blend(value);
    this.poseSlider.set(this.viewer.value);
    this.poseBar.choose(this.poses[Math.round(this.viewer.value)].key);
    this.describePose();
  }

  /** Between the last pose and the one before it: refined and initial, or refined and as given. */
  togglePose() {
    const last = this.poses.length - 1;
    this.blend(this.viewer.value === last ? last - 1 : last);
  }

  pullApart(share) {
    this.apartSlider.set(share);
    this.viewer.pullApart(share);
    this.describePose();
  }

  showSet(index, shown) {
    const { input } = this.setBoxes[index];
    if (input.checked !== shown) input.click();
  }

  describePose() {
    const apart = this.viewer.apart > 0 ? ", pulled apart" : "";
    this.caption.textContent = `Source ${this.poseText(this.viewer.value)}${apart}`;
  }

  poseText(value) {
    const before = Math.floor(value);
    const share = Math.round((value - before) * 100);
    if (share === 0) return this.poses[before].name;
    return `${share} % of the way from ${this.poses[before].name} to ${this.poses[before + 1].name}`;
  }

  setColour(mode) {
    this.mode = mode;
    this.viewer.setColour(mode);
    this.colourBar.choose(mode);
    this.legend.replaceChildren(...legendOf(mode, this.scene));
  }

  toggleCloud(name) {
    this.cloudBoxes[name].click();
  }

  toggleSets() {
    const shown = !this.setBoxes.some((box) => box.input.checked);
    this.setBoxes.forEach((_, index) => this.showSet(index, shown));
  }

  changePointSize(steps) {
    this.sizeSlider.set(this.sizeSlider.input.valueAsNumber + steps * 0.25);
    this.viewer.setPointScale(2 ** this.sizeSlider.input.valueAsNumber);
  }

  async savePicture() {
    const address = URL.createObjectURL(await this.viewer.picture());
    element("a", { href: address, download: "registration.png" }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }

  // ---- keys

  bindKeys(container) {
    const section = container.closest("section");
    document.addEventListener("keydown", (event) => {
      const here = event.target === document.body || section.contains(event.target);
      if (!here || event.ctrlKey || event.metaKey || event.altKey) return;
      const action = this.keyAction(event);
      if (!action) return;
      event.preventDefault();
      action();
    });
  }

  keyAction(event) {
    const pose = this.poses[Number(event.key) - 1];
    if (pose) return () => this.setPose(pose.key);
    if (event.target === this.viewer.canvas) return this.cameraAction(event) ?? this.letterAction(event.key);
    return this.letterAction(event.key);
  }

  letterAction(key) {
    const preset = presets.find(([, , letter]) => letter === key);
    if (preset) return () => this.viewer.lookFrom(preset[0]);
    return {
      t: () => this.togglePose(),
      c: () => this.setColour(colourModes[(colourModes.indexOf(this.mode) + 1) % colourModes.length]),
      b: () => this.toggleCloud("reference"),
      o: () => this.toggleCloud("source"),
      l: () => this.toggleSets(),
      "+": () => this.changePointSize(1),
      "-": () => this.changePointSize(-1),
      "?": () => { this.keysDetails.open = !this.keysDetails.open; },
    }[key];
  }

  cameraAction(event) {
    const { viewer } = this;
    const directions = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const direction = directions[event.key];
    if (direction && event.shiftKey) return () => viewer.shift(direction[0] * 30, direction[1] * 30);
    if (direction) return () => viewer.turn(direction[0] * 0.1, direction[1] * 0.1);
    return { PageUp: () => viewer.nearer(1.15), PageDown: () => viewer.nearer(1 / 1.15) }[event.key];
  }

  // ---- colours of the page

  /** Takes the background from the style sheet, after a change of theme. */
  followTheme() {
    const colour = getComputedStyle(this.picture).backgroundColor;
    this.viewer.setBackground(colour.match(/\d+/g).slice(0, 3).map(Number));
  }

  /** Prints on white, whatever the theme; the print is made of the picture as it stands. */
  bindPrinting() {
    addEventListener("beforeprint", () => {
      this.viewer.setBackground([255, 255, 255]);
      this.viewer.render();
    });
    addEventListener("afterprint", () => this.followTheme());
  }
}

function shownPoints(cloud) {
  if (cloud.shown === cloud.points) return count(cloud.points);
  return `${count(cloud.shown)} of ${count(cloud.points)}`;
}

function legendOf(mode, scene) {
  if (mode === "residual") return residualLegend(scene.residual_end);
  if (mode === "visibility") return visibilityKinds.map((kind) => legendEntry(kind.colour, kind.name, kind.meaning));
  return ["source", "reference"].map((name) => legendEntry(cloudColours[name], name));
}

function residualLegend(end) {
  const ends = element("div", { class: "ramp-ends" }, element("span", { text: "0" }), element("span", { text: metres(end / 2) }), element("span", { text: metres(end) }));
  const bar = element("div", { class: "ramp", style: `background:${viridisGradient()}` });
  const scale = element("div", { class: "ramp-block" }, element("div", { text: "Distance to the other cloud" }), bar, ends);
  return [scale, legendEntry(beyondColour, "farther")];
}

function legendEntry(colour, name, meaning) {
  return element("span", { class: "legend-entry", title: meaning }, element("i", { class: "swatch", style: `background:${colour}` }), element("span", { text: name }));
}
