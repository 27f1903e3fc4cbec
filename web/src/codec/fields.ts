/** Fields of a payload, one after the other; whatever is not legal is refused with the section's name. */

import { CorruptSection } from "../errors.ts";

const MAX_VARINT_BYTES = 9;

export class FieldReader {
  private readonly view: DataView;
  position = 0;

  constructor(
    readonly bytes: Uint8Array,
    /** Name of the section, with which every message begins. */
    readonly section: string,
  ) {
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  get left(): number {
    return this.bytes.length - this.position;
  }

  refuse(problem: string): never {
    throw new CorruptSection(`${this.section}: ${problem}`);
  }

  /** Start of the next `count` bytes. */
  private take(count: number, what: string): number {
    if (count > this.left) this.refuse(`${what} needs ${count} bytes, ${this.left} are left`);
    const start = this.position;
    this.position += count;
    return start;
  }

  u8(what: string): number {
    return this.view.getUint8(this.take(1, what));
  }

  i8(what: string): number {
    return this.view.getInt8(this.take(1, what));
  }

  u16(what: string): number {
    return this.view.getUint16(this.take(2, what), true);
  }

  i16(what: string): number {
    return this.view.getInt16(this.take(2, what), true);
  }

  u32(what: string): number {
    return this.view.getUint32(this.take(4, what), true);
  }

  f32(what: string): number {
    return this.view.getFloat32(this.take(4, what), true);
  }

  f64(what: string): number {
    return this.view.getFloat64(this.take(8, what), true);
  }

  slice(count: number, what: string): Uint8Array {
    const start = this.take(count, what);
    return this.bytes.subarray(start, start + count);
  }

  /** Numbers above 2^53 lose digits; all legal ranges end far below. */
  varint(what: string, least: number, most: number, maxBytes = MAX_VARINT_BYTES): number {
    let value = 0;
    let scale = 1;
    for (let count = 1; ; count++) {
      if (count > maxBytes) this.refuse(`${what} has more than ${maxBytes} bytes`);
      const byte = this.u8(what);
      value += (byte & 0x7f) * scale;
      scale *= 128;
      if (byte & 0x80) continue;
      if (byte === 0 && count > 1) this.refuse(`${what} is not written in the fewest bytes`);
      break;
    }
    if (value < least || value > most) this.refuse(`${what} is ${value}, expected ${least} to ${most}`);
    return value;
  }

  signedVarint(what: string, least: number, most: number, maxBytes = MAX_VARINT_BYTES): number {
    const coded = this.varint(what, 0, Infinity, maxBytes);
    const value = coded % 2 ? -(coded + 1) / 2 : coded / 2;
    if (value < least || value > most) this.refuse(`${what} is ${value}, expected ${least} to ${most}`);
    return value;
  }

  end(): void {
    if (this.left) this.refuse(`${this.left} bytes after the last field`);
  }
}
