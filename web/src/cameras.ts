/** Cameras as in docs/conventions.md: OpenCV axes (x right, y down, z forward), pixels, world units. */

export interface Camera {
  width: number;
  height: number;
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  /** 4 x 4, row by row: x_camera = R x_world + t */
  worldToCamera: ArrayLike<number>;
}

/** The camera's centre -R^T t, in the world. */
export function cameraCentre({ worldToCamera: m }: Pick<Camera, "worldToCamera">): [number, number, number] {
  const along = (column: number): number =>
    -(m[column]! * m[3]! + m[4 + column]! * m[7]! + m[8 + column]! * m[11]!);
  return [along(0), along(1), along(2)];
}

/** 4 x 4 world to camera of a rotation (unit quaternion w, x, y, z) and a camera's centre. */
export function poseOf(
  [w, x, y, z]: ArrayLike<number> & Iterable<number>,
  centre: ArrayLike<number>,
): Float64Array {
  const r = [
    1 - 2 * (y! * y! + z! * z!),
    2 * (x! * y! - w! * z!),
    2 * (x! * z! + w! * y!),
    2 * (x! * y! + w! * z!),
    1 - 2 * (x! * x! + z! * z!),
    2 * (y! * z! - w! * x!),
    2 * (x! * z! - w! * y!),
    2 * (y! * z! + w! * x!),
    1 - 2 * (x! * x! + y! * y!),
  ] as const;
  const pose = new Float64Array(16);
  for (let row = 0; row < 3; row++) {
    let t = 0;
    for (let column = 0; column < 3; column++) {
      pose[4 * row + column] = r[3 * row + column]!;
      t -= r[3 * row + column]! * centre[column]!;
    }
    pose[4 * row + 3] = t;
  }
  pose[15] = 1;
  return pose;
}
