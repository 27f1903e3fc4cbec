/** Where to look from (docs/bitstream.md, "Viewpoints"). */

import { FieldReader } from "./fields.ts";

const MAX_COMPONENT = 16383;
const COMPONENT_UNIT = MAX_COMPONENT * Math.SQRT2;
/** Of three stored components: 3/4 and what their rounding adds. Beyond it the fourth would not be the largest. */
const MAX_SQUARES = 3 * 2 ** 27;
const UP_UNIT = 127;
const POSITION_UNIT = 32767;

export interface Viewpoint {
  /** Pixels; the principal point is the middle of the image. */
  width: number;
  height: number;
  fx: number;
  fy: number;
  /** Camera centre, world units without `worldOffset`. */
  position: [number, number, number];
  /** World to camera: unit quaternion w, x, y, z. */
  rotation: [number, number, number, number];
}

export interface Viewpoints {
  /** Unit vector. */
  up: [number, number, number];
  centre: [number, number, number];
  radius: number;
  views: Viewpoint[];
}

export function readViewpoints(payload: Uint8Array, name: string): Viewpoints {
  const reader = new FieldReader(payload, name);
  const length = (what: string, value: number): number => {
    if (!(value > 0 && value < Infinity))
      reader.refuse(`${what} is ${value}, expected a finite number above 0`);
    return value;
  };
  const coordinate = (): number => {
    const value = reader.f32("centre");
    if (!Number.isFinite(value)) reader.refuse(`centre is ${value}`);
    return value;
  };
  const up: [number, number, number] = [reader.i8("up"), reader.i8("up"), reader.i8("up")];
  const norm = Math.hypot(...up);
  if (norm === 0) reader.refuse("up has no direction");
  if (Math.min(...up) < -UP_UNIT) reader.refuse(`up is ${up}, expected ${-UP_UNIT} or more`);
  const centre: [number, number, number] = [coordinate(), coordinate(), coordinate()];
  const radius = length("radius", reader.f32("radius"));
  const lensCount = reader.u8("lenses");
  if (lensCount < 1 || lensCount > 16) reader.refuse(`${lensCount} lenses, expected 1 to 16`);
  const lenses = Array.from({ length: lensCount }, () => {
    const [width, height] = [reader.u16("width"), reader.u16("height")];
    if (!width || !height) reader.refuse(`an image of ${width} x ${height} pixels`);
    return { width, height, fx: length("fx", reader.f32("fx")), fy: length("fy", reader.f32("fy")) };
  });
  const viewCount = reader.u8("views");
  if (viewCount < 1) reader.refuse("no views");
  const views = Array.from({ length: viewCount }, () => {
    const lens = lenses[reader.u8("lens")];
    if (!lens) return reader.refuse("a view has a lens that is not there");
    const along = (axis: number): number => {
      const place = reader.i16("position");
      if (place < -POSITION_UNIT) reader.refuse(`a position is ${place}, expected ${-POSITION_UNIT} or more`);
      return centre[axis]! + (radius * place) / POSITION_UNIT;
    };
    const position: [number, number, number] = [along(0), along(1), along(2)];
    return { ...lens, position, rotation: readRotation(reader) };
  });
  reader.end();
  return { up: [up[0] / norm, up[1] / norm, up[2] / norm], centre, radius, views };
}

function readRotation(reader: FieldReader): [number, number, number, number] {
  const low = reader.u16("rotation");
  const packed = low + 65536 * reader.u32("rotation");
  if (packed >= 2 ** 47) reader.refuse("bit 47 of a rotation is not 0");
  const largest = packed % 4;
  const stored = [0, 1, 2].map((i) => {
    const bits = Math.floor(packed / 2 ** (2 + 15 * i)) % 32768;
    return bits >= 16384 ? bits - 32768 : bits;
  });
  const squares = stored.reduce((sum, x) => sum + x * x, 0);
  if (squares > MAX_SQUARES || stored.some((x) => x < -MAX_COMPONENT)) {
    reader.refuse(`a rotation's components are ${stored}, beyond those of a unit quaternion`);
  }
  const others = stored.map((x) => x / COMPONENT_UNIT);
  const rest = 1 - others.reduce((sum, x) => sum + x * x, 0);
  others.splice(largest, 0, Math.sqrt(rest));
  return others as [number, number, number, number];
}
