// Where the viewer's camera stands for each preset, in the display frame of the reference.

import { Box3, Matrix4, Vector3 } from "three";

/** Axes of the sensors in their own frames; objects have no sensor. */
const sensors = {
  indoor: { forward: new Vector3(0, 0, 1), up: new Vector3(0, -1, 0), angle: 48 },
  lidar: { forward: new Vector3(1, 0, 0), up: new Vector3(0, 0, 1), angle: 70 },
};
const usualAngle = 40;
const fitMargin = 1.1;

/** Matrix of a pose given by rows. */
export function matrixOf(rows) {
  return new Matrix4().set(...rows.flat());
}

/** A few thousand points of a cloud, without the outermost share along each axis: stray points would make the scene tiny. */
export function samplePoints(cloud, outermost) {
  const step = Math.max(1, Math.floor(cloud.count / 4000));
  const points = [];
  for (let index = 0; index < cloud.count; index += step) points.push(pointOf(cloud, index));
  const box = innerBox(points, outermost);
  const inside = points.filter((point) => box.containsPoint(point));
  return inside.length > 0 ? inside : [new Vector3()];
}

function innerBox(points, outermost) {
  const ranges = [0, 1, 2].map((axis) => innerRange(points.map((point) => point.getComponent(axis)), outermost));
  return new Box3(new Vector3(...ranges.map(([low]) => low)), new Vector3(...ranges.map(([, high]) => high)));
}

function innerRange(values, outermost) {
  if (values.length === 0) return [0, 1];
  values.sort((a, b) => a - b);
  const at = (share) => values[Math.round(share * (values.length - 1))];
  return [at(outermost), at(1 - outermost)];
}

/** One point of a decoded cloud, in its display frame. */
export function pointOf(cloud, index, target = new Vector3()) {
  const axis = (which) => cloud.low[which] + (cloud.size[which] * cloud.positions[4 * index + which]) / 65535;
  return target.set(axis(0), axis(1), axis(2));
}

/** The usual distance between neighbouring points: that of a sample, scaled as surfaces scale. */
export function spacingOf(cloud) {
  const sample = [];
  const step = Math.max(1, Math.floor(cloud.count / 3000));
  for (let index = 0; index < cloud.count; index += step) sample.push(pointOf(cloud, index));
  const nearest = [];
  for (let index = 0; index < sample.length; index += 20) nearest.push(nearestDistance(sample, index));
  nearest.sort((a, b) => a - b);
  return (nearest[Math.floor(nearest.length / 2)] ?? 0.01) / Math.sqrt(step);
}

function nearestDistance(points, index) {
  let least = Infinity;
  points.forEach((point, other) => {
    if (other !== index) least = Math.min(least, point.distanceToSquared(points[index]));
  });
  return Number.isFinite(least) ? Math.sqrt(least) : 0.01;
}

/** Preset cameras: each gives `position`, `target`, `up` and the vertical `angle` of view in degrees. */
export class CameraPresets {
  /** `points`: a sample of both clouds. */
  constructor(scene, points) {
    this.kind = scene.kind;
    this.up = new Vector3(...scene.up).normalize();
    this.points = points;
    const bounds = new Box3().setFromPoints(points);
    this.centre = bounds.getCenter(new Vector3());
    this.radius = Math.max(bounds.getSize(new Vector3()).length() / 2, 1e-6);
  }

  /** The direction in which the reference's sensor looks, made level. */
  levelForward() {
    const forward = (sensors[this.kind]?.forward ?? sideways(this.up)).clone();
    forward.addScaledVector(this.up, -forward.dot(this.up));
    return forward.lengthSq() > 1e-6 ? forward.normalize() : sideways(this.up);
  }

  /** From behind and above, with all `points` (by default both clouds) in the picture. */
  fit(aspect, points) {
    const forward = this.levelForward();
    const side = new Vector3().crossVectors(forward, this.up);
    const height = this.kind === "lidar" ? 0.9 : 0.5;
    const away = forward.clone().negate().addScaledVector(this.up, height).addScaledVector(side, 0.45).normalize();
    return this.from(away, aspect, points);
  }

  /** From above; what the reference's sensor faced is at the top of the picture. */
  top(aspect, points) {
    const away = this.up.clone().addScaledVector(this.levelForward(), -1e-3).normalize();
    return this.from(away, aspect, points);
  }

  /** From the direction `away`, just so far that all points are in the picture. */
  from(away, aspect, points = this.points) {
    const half = Math.tan((usualAngle * Math.PI) / 360) / fitMargin;
    const right = new Vector3().crossVectors(this.up, away).normalize();
    const lens = { away, right, above: new Vector3().crossVectors(away, right), high: half, wide: half * aspect };
    let target = new Box3().setFromPoints(points).getCenter(new Vector3());
    // Twice: perspective shifts the middle of the picture away from the middle of the box.
    for (let round = 0; round < 2; round += 1) target = middleInPicture(points, target, lens);
    const position = target.clone().addScaledVector(away, distanceFor(points, target, lens));
    return { position, target, up: this.up, angle: usualAngle };
  }

  /** As the sensor of a cloud saw it; `pose` moves the cloud into the reference. Objects are seen from their front. */
  sensor(pose, aspect) {
    const axes = sensors[this.kind];
    const position = new Vector3().setFromMatrixPosition(pose);
    if (!axes || position.distanceTo(this.centre) > 4 * this.radius) return this.front(pose, aspect);
    const forward = axes.forward.clone().transformDirection(pose);
    const reach = Math.max(forward.dot(this.centre.clone().sub(position)), 0.3 * this.radius);
    const target = position.clone().addScaledVector(forward, reach);
    return { position, target, up: axes.up.clone().transformDirection(pose), angle: axes.angle };
  }

  front(pose, aspect) {
    const away = this.levelForward().negate().addScaledVector(this.up, 0.3).transformDirection(pose);
    return this.from(away, aspect);
  }
}

/** How far from `target` a camera must stand to have all points in its picture. */
function distanceFor(points, target, { away, right, above, high, wide }) {
  return points.reduce((most, point) => {
    const offset = point.clone().sub(target);
    const side = Math.max(Math.abs(offset.dot(right)) / wide, Math.abs(offset.dot(above)) / high);
    return Math.max(most, side + offset.dot(away));
  }, 1e-6);
}

function middleInPicture(points, target, lens) {
  const distance = distanceFor(points, target, lens);
  const middle = [lens.right, lens.above].map((axis) => {
    const places = points.map((point) => {
      const offset = point.clone().sub(target);
      return offset.dot(axis) / Math.max(distance - offset.dot(lens.away), 1e-6);
    });
    return ((Math.min(...places) + Math.max(...places)) / 2) * distance;
  });
  return target.clone().addScaledVector(lens.right, middle[0]).addScaledVector(lens.above, middle[1]);
}

function sideways(up) {
  const candidate = Math.abs(up.x) < 0.7 ? new Vector3(1, 0, 0) : new Vector3(0, 1, 0);
  return candidate.addScaledVector(up, -candidate.dot(up)).normalize();
}
