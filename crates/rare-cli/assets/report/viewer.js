// The three-dimensional viewer: two clouds, the correspondences between them, one camera. It draws only when something
// changed; there is no loop while nothing happens.

import * as THREE from "three";
import { OrbitControls } from "three/OrbitControls";

import { CameraPresets, samplePoints, spacingOf } from "report/cameras";
import { bytesOf, cloudColours, matchColours, residualPalette, visibilityPalette } from "report/colours";
import { PosePath } from "report/poses";
import { lineShader, pointShader, shadeShader } from "report/shaders";

export const colourModes = ["cloud", "residual", "visibility"];
/** A fine picture has this many samples across and down each of its pixels. */
const fineSamples = 2;
/** Pixels across of a saved picture. */
const printWidth = 2400;
const lineStyles = {
  inlier: { width: 1.5, opacity: 0.75, dash: 0 },
  outlier: { width: 1.1, opacity: 0.6, dash: 9 },
};

export class Viewer {
  /** Throws when there is no WebGL. `clouds` and `matches` are decoded (`report/data`). */
  constructor(container, scene, clouds, matches) {
    this.container = container;
    this.poses = scene.poses;
    this.renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    this.renderer.autoClear = false;
    this.canvas = this.renderer.domElement;
    container.append(this.canvas);
    this.background = new THREE.Vector3(1, 1, 1);
    this.path = new PosePath(scene.poses, middleOf(clouds.source));
    this.makePresets(scene, clouds);
    this.makeClouds(clouds);
    this.makeLines(matches);
    this.makeShading();
    this.makeCamera();
    this.apart = 0;
    this.apartDirection = new THREE.Vector3();
    this.blend(this.path.last);
    this.setColour("cloud");
    this.followSize();
    this.lookFrom("fit");
  }

  // ---- making

  makePresets(scene, clouds) {
    const outermost = scene.kind === "lidar" ? 0.04 : 0.005; // a rotating scanner's far points are few and lone
    this.samples = { reference: samplePoints(clouds.reference, outermost), source: samplePoints(clouds.source, outermost) };
    const { reference } = this.samples;
    const final = new CameraPresets(scene, [...reference, ...this.sourceSample(this.path.at(this.path.last))]);
    // The pose before the last also has its place in the picture, unless it is so far off that all would look small.
    const both = new CameraPresets(scene, [...final.points, ...this.sourceSample(this.path.at(this.path.last - 1))]);
    this.presets = both.radius < 1.5 * final.radius ? both : final;
  }

  sourceSample(pose) {
    return this.samples.source.map((point) => point.clone().applyMatrix4(pose));
  }

  makeClouds(clouds) {
    this.palettes = { residual: paletteTexture(residualPalette()), visibility: paletteTexture(visibilityPalette()) };
    this.shared = {
      chosenPose: { value: new THREE.Vector4() },
      mode: { value: 0 },
      palette: { value: this.palettes.residual },
      pixelsPerUnit: { value: 1 },
      smallest: { value: 1.5 },
    };
    this.pointScene = new THREE.Scene();
    this.clouds = {};
    for (const name of ["reference", "source"]) {
      const points = makePoints(clouds[name], name, this.shared);
      this.clouds[name] = points;
      this.pointScene.add(points);
    }
  }

  makeLines(matches) {
    this.lineShared = { referenceFromSource: { value: new THREE.Matrix4() }, resolution: { value: new THREE.Vector2(1, 1) }, nearest: { value: 0.01 } };
    this.lineScene = new THREE.Scene();
    this.kindsShown = { inlier: true, outlier: true };
    this.sets = matches.map((set) => {
      const lines = { shown: false, inlier: makeLineMesh(set.inlier, "inlier", this.lineShared), outlier: makeLineMesh(set.outlier, "outlier", this.lineShared) };
      this.lineScene.add(lines.outlier, lines.inlier);
      return lines;
    });
    this.updateLines();
  }

  makeShading() {
    this.targets = { quick: makeTarget(), fine: makeTarget() };
    this.shade = new THREE.ShaderMaterial({
      vertexShader: shadeShader.vertex,
      fragmentShader: shadeShader.fragment,
      depthTest: false,
      depthWrite: false,
      uniforms: {
        colours: { value: null },
        depths: { value: null },
        pixel: { value: new THREE.Vector2() },
        samples: { value: 1 },
        reach: { value: 1 },
        background: { value: this.background },
        near: { value: 0.1 },
        far: { value: 100 },
        strength: { value: 14 },
      },
    });
    const screen = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), this.shade);
    screen.frustumCulled = false;
    this.screenScene = new THREE.Scene().add(screen);
  }

  makeCamera() {
    const { radius } = this.presets;
    this.camera = new THREE.PerspectiveCamera(45, 1, radius * 0.004, radius * 40);
    this.shade.uniforms.near.value = this.camera.near;
    this.shade.uniforms.far.value = this.camera.far;
    this.lineShared.nearest.value = this.camera.near;
  }

  /** The controls keep the direction that was up when they were made, so a view with another one needs new ones. */
  makeControls(target) {
    this.controls?.dispose();
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.enableZoom = this.zooming ?? false;
    this.controls.zoomToCursor = true;
    this.controls.minDistance = this.presets.radius * 0.01;
    this.controls.maxDistance = this.presets.radius * 15;
    this.controls.target.copy(target);
    this.controls.update();
    this.controls.addEventListener("change", () => this.requestRender());
  }

  followSize() {
    this.resize();
    new ResizeObserver(() => this.resize()).observe(this.container);
  }

  resize(ratio = Math.min(window.devicePixelRatio || 1, 2)) {
    const width = Math.max(this.container.clientWidth, 1);
    const height = Math.max(this.container.clientHeight, 1);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height);
    const pixels = this.renderer.getDrawingBufferSize(new THREE.Vector2());
    this.targets.quick.setSize(pixels.x, pixels.y);
    this.targets.fine.setSize(pixels.x * fineSamples, pixels.y * fineSamples);
    this.lineShared.resolution.value.set(pixels.x / ratio, pixels.y / ratio);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.requestRender();
  }

  // ---- what the page and the keys change

  /** The source at `value` along the poses: 0 the first, 1 the second; the colours are those of the nearer pose. */
  blend(value) {
    this.value = Math.min(Math.max(value, 0), this.path.last);
    const chosen = Math.round(this.value);
    this.shared.chosenPose.value.fromArray([0, 1, 2, 3].map((index) => (index === chosen ? 1 : 0)));
    this.moveSource();
  }

  /**
   * Moves the source aside by this share of the scene's size, to the left in the picture, so that the lines between
   * aligned clouds can be seen; the camera steps back to keep both clouds in the picture.
   */
  pullApart(share) {
    if (this.apart === 0) this.apartDirection.setFromMatrixColumn(this.camera.matrixWorld, 0);
    this.apart = share;
    this.moveSource();
    const away = this.camera.position.clone().sub(this.controls.target).normalize();
    this.placeCamera(this.presets.from(away, this.camera.aspect, this.framedPoints()));
  }

  moveSource() {
    const pose = this.sourcePose();
    const source = this.clouds.source;
    source.matrix.multiplyMatrices(pose, source.userData.unitToCloud);
    source.matrixWorldNeedsUpdate = true;
    this.lineShared.referenceFromSource.value.copy(pose);
    this.requestRender();
  }

  /** The pose as drawn: on the path, and pulled apart. */
  sourcePose() {
    const offset = this.apartDirection.clone().multiplyScalar(-1.6 * this.apart * this.presets.radius);
    return new THREE.Matrix4().makeTranslation(offset).multiply(this.path.at(this.value));
  }

  /** What presets keep in the picture; undefined for their usual choice. */
  framedPoints() {
    return this.apart === 0 ? undefined : [...this.samples.reference, ...this.sourceSample(this.sourcePose())];
  }

  setColour(mode) {
    this.shared.mode.value = colourModes.indexOf(mode);
    this.shared.palette.value = this.palettes[mode] ?? this.palettes.residual;
    this.requestRender();
  }

  setPointScale(scale) {
    for (const points of Object.values(this.clouds)) points.material.uniforms.diameter.value = points.userData.diameter * scale;
    this.requestRender();
  }

  setCloudShown(name, shown) {
    this.clouds[name].visible = shown;
    this.requestRender();
  }

  setSetShown(index, shown) {
    this.sets[index].shown = shown;
    this.updateLines();
  }

  setKindShown(kind, shown) {
    this.kindsShown[kind] = shown;
    this.updateLines();
  }

  updateLines() {
    for (const lines of this.sets) {
      for (const kind of ["inlier", "outlier"]) lines[kind].visible = lines.shown && this.kindsShown[kind] && lines[kind].geometry.instanceCount > 0;
    }
    this.requestRender();
  }

  /** Zooming by the wheel is on only while the picture has the focus, so that the page can be scrolled past it. */
  setZooming(zooming) {
    this.zooming = zooming;
    this.controls.enableZoom = zooming;
  }

  /** `preset`: "fit", "top", "reference" or "source". */
  lookFrom(preset) {
    this.placeCamera(this.presetView(preset));
  }

  placeCamera(view) {
    this.camera.up.copy(view.up);
    this.camera.fov = view.angle;
    this.camera.position.copy(view.position);
    this.camera.updateProjectionMatrix();
    this.makeControls(view.target);
    this.requestRender();
  }

  presetView(preset) {
    const { aspect } = this.camera;
    if (preset === "fit" || preset === "top") return this.presets[preset](aspect, this.framedPoints());
    const pose = preset === "source" ? this.sourcePose() : new THREE.Matrix4();
    return this.presets.sensor(pose, aspect);
  }

  /** Turns by angles in radians, or moves by pixels, or comes nearer by a factor: for the keys. */
  turn(left, up) {
    this.controls.rotateLeft(left);
    this.controls.rotateUp(up);
    this.controls.update();
  }

  shift(right, down) {
    this.controls.pan(right, down);
    this.controls.update();
  }

  nearer(factor) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    this.camera.position.copy(this.controls.target).addScaledVector(offset, 1 / factor);
    this.controls.update();
    this.requestRender();
  }

  /** `bytes`: red, green and blue, 0 to 255. */
  setBackground(bytes) {
    this.background.fromArray(bytes.map((byte) => byte / 255));
    this.requestRender();
  }

  // ---- drawing

  /** Draws soon, quickly; and again in fine quality when nothing has changed for a moment. */
  requestRender() {
    this.requested ||= requestAnimationFrame(() => {
      this.draw(this.targets.quick, 1);
      clearTimeout(this.refining);
      this.refining = setTimeout(() => this.render(), 160);
    });
  }

  /** Draws at once, in fine quality. */
  render() {
    this.draw(this.targets.fine, fineSamples);
  }

  draw(target, samples) {
    cancelAnimationFrame(this.requested);
    clearTimeout(this.refining);
    this.requested = 0;
    this.prepare(target, samples);
    this.renderer.setRenderTarget(target);
    this.renderer.clear();
    this.renderer.render(this.pointScene, this.camera);
    this.renderer.setRenderTarget(null);
    this.renderer.clear();
    this.renderer.render(this.screenScene, this.camera);
    this.renderer.render(this.lineScene, this.camera);
  }

  prepare(target, samples) {
    const ratio = this.renderer.getPixelRatio();
    const { uniforms } = this.shade;
    this.shared.pixelsPerUnit.value = target.height / (2 * Math.tan((this.camera.fov * Math.PI) / 360));
    this.shared.smallest.value = 1.9 * ratio * samples;
    uniforms.colours.value = target.texture;
    uniforms.depths.value = target.depthTexture;
    uniforms.pixel.value.set(1 / target.width, 1 / target.height);
    uniforms.samples.value = samples;
    uniforms.reach.value = 1.3 * ratio * samples;
  }

  /** Draws at once and reads the picture back: width, height and RGBA bytes, rows from the bottom. */
  pixels() {
    this.render();
    const context = this.renderer.getContext();
    const { width, height } = this.canvas;
    const data = new Uint8Array(width * height * 4);
    context.readPixels(0, 0, width, height, context.RGBA, context.UNSIGNED_BYTE, data);
    return { width, height, data };
  }

  /** The picture as a PNG, wide enough for print. */
  async picture() {
    this.resize(Math.min(Math.max(printWidth / this.container.clientWidth, window.devicePixelRatio || 1), 4));
    this.render();
    const blob = await new Promise((resolve) => { this.canvas.toBlob(resolve, "image/png"); });
    this.resize();
    return blob;
  }
}

function makeTarget() {
  const target = new THREE.WebGLRenderTarget(1, 1, { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter });
  target.depthTexture = new THREE.DepthTexture(1, 1, THREE.UnsignedIntType);
  return target;
}

function middleOf(cloud) {
  return new THREE.Vector3(...cloud.low).addScaledVector(new THREE.Vector3(...cloud.size), 0.5);
}

function paletteTexture(entries) {
  const texture = new THREE.DataTexture(entries, 256, 1, THREE.RGBAFormat);
  texture.needsUpdate = true;
  return texture;
}

function makePoints(cloud, name, shared) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(cloud.positions, 4, true));
  geometry.setAttribute("residuals", new THREE.BufferAttribute(cloud.residuals, 4, true));
  geometry.setAttribute("visibility", new THREE.BufferAttribute(cloud.visibility, 4, true));
  const diameter = 2.2 * spacingOf(cloud);
  const colour = new THREE.Vector3(...bytesOf(cloudColours[name]).map((byte) => byte / 255));
  const material = new THREE.ShaderMaterial({
    vertexShader: pointShader.vertex,
    fragmentShader: pointShader.fragment,
    uniforms: { ...shared, cloudColour: { value: colour }, diameter: { value: diameter } },
  });
  const points = new THREE.Points(geometry, material);
  points.frustumCulled = false;
  points.matrixAutoUpdate = false;
  // Positions are 0 to 1 of the cloud's box; the object's matrix makes metres of them.
  const box = new THREE.Matrix4().makeTranslation(...cloud.low).multiply(new THREE.Matrix4().makeScale(...cloud.size));
  points.userData = { unitToCloud: box, diameter };
  points.matrix.copy(box);
  return points;
}

function makeLineMesh(ends, kind, shared) {
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 0, 1, -1, 0, 1, 1, 0, 0, 1, 0], 3));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  const pairs = new THREE.InstancedInterleavedBuffer(ends, 6);
  geometry.setAttribute("sourceEnd", new THREE.InterleavedBufferAttribute(pairs, 3, 0));
  geometry.setAttribute("referenceEnd", new THREE.InterleavedBufferAttribute(pairs, 3, 3));
  geometry.instanceCount = ends.length / 6;
  const style = lineStyles[kind];
  const colour = new THREE.Vector3(...bytesOf(matchColours[kind]).map((byte) => byte / 255));
  const material = new THREE.ShaderMaterial({
    vertexShader: lineShader.vertex,
    fragmentShader: lineShader.fragment,
    uniforms: {
      referenceFromSource: shared.referenceFromSource,
      resolution: shared.resolution,
      nearest: shared.nearest,
      lineColour: { value: colour },
      width: { value: style.width },
      opacity: { value: style.opacity },
      dash: { value: style.dash },
    },
    transparent: true,
    depthTest: false,
    depthWrite: false,
    side: THREE.DoubleSide,
  });
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  return mesh;
}
