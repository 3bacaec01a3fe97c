// Rigid motion between the poses of the source.

import { Matrix4, Quaternion, Vector3 } from "three";

import { matrixOf } from "report/cameras";

/**
 * The poses in order as one path: 0 is the first, 1 the second, and between them the source turns evenly about its own
 * centre while that centre moves along a straight line.
 */
export class PosePath {
  constructor(poses, centre) {
    this.centre = centre;
    this.stops = poses.map((pose) => this.stopOf(matrixOf(pose.rows)));
  }

  stopOf(matrix) {
    const rotation = new Quaternion().setFromRotationMatrix(matrix);
    return { rotation, centre: this.centre.clone().applyMatrix4(matrix) };
  }

  get last() {
    return this.stops.length - 1;
  }

  /** The pose at `value`, from 0 to the number of the last pose. */
  at(value) {
    const before = Math.min(Math.max(Math.floor(value), 0), Math.max(this.last - 1, 0));
    const [from, to] = [this.stops[before], this.stops[Math.min(before + 1, this.last)]];
    const share = Math.min(Math.max(value - before, 0), 1);
    const rotation = from.rotation.clone().slerp(to.rotation, share);
    const centre = from.centre.clone().lerp(to.centre, share);
    const turned = this.centre.clone().applyQuaternion(rotation);
    return new Matrix4().compose(centre.sub(turned), rotation, new Vector3(1, 1, 1));
  }
}
