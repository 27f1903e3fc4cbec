/** A camera's pose in the local frame, and how it turns and moves. Vectors are [x, y, z]. */

export type Vector = [number, number, number];

export const add = (a: Vector, b: Vector, scale = 1): Vector => [
  a[0] + scale * b[0],
  a[1] + scale * b[1],
  a[2] + scale * b[2],
];
export const dot = (a: Vector, b: Vector): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a: Vector, b: Vector): Vector => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const unit = (a: Vector): Vector => {
  const length = Math.hypot(...a);
  return length > 0 ? [a[0] / length, a[1] / length, a[2] / length] : [0, 0, 1];
};

/** `v` turned about the unit vector `axis`, radians, right-handed. */
export function turned(v: Vector, axis: Vector, angle: number): Vector {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add([c * v[0], c * v[1], c * v[2]], cross(axis, v), s), axis, dot(axis, v) * (1 - c));
}

/** OpenCV axes: right, down and forward are the rows of the rotation. */
export class Pose {
  constructor(
    public centre: Vector,
    public right: Vector,
    public down: Vector,
    public forward: Vector,
  ) {}

  static lookingAt(centre: Vector, target: Vector, up: Vector): Pose {
    const forward = unit(add(target, centre, -1));
    let right = cross(forward, up);
    if (Math.hypot(...right) < 1e-6)
      right = cross(forward, Math.abs(forward[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
    right = unit(right);
    return new Pose(centre, right, cross(forward, right), forward);
  }

  /** Of a rotation world to camera, a unit quaternion w, x, y, z. */
  static of(centre: Vector, [w, x, y, z]: [number, number, number, number]): Pose {
    return new Pose(
      centre,
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    );
  }

  get rotation(): number[] {
    return [...this.right, ...this.down, ...this.forward];
  }

  get translation(): Vector {
    return [-dot(this.right, this.centre), -dot(this.down, this.centre), -dot(this.forward, this.centre)];
  }

  /** Turns about `axis`, about the camera itself or about `pivot`. */
  turn(axis: Vector, angle: number, pivot: Vector = this.centre): void {
    this.right = unit(turned(this.right, axis, angle));
    this.forward = turned(this.forward, axis, angle);
    // Small errors of many turns must not skew the axes.
    this.forward = unit(add(this.forward, this.right, -dot(this.forward, this.right)));
    this.down = cross(this.forward, this.right);
    this.centre = add(pivot, turned(add(this.centre, pivot, -1), axis, angle));
  }

  move(right: number, down: number, forward: number): void {
    this.centre = add(add(add(this.centre, this.right, right), this.down, down), this.forward, forward);
  }

  copy(): Pose {
    return new Pose([...this.centre], [...this.right], [...this.down], [...this.forward]);
  }
}
