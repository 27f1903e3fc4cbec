/** Arrays of integers of known sizes (docs/bitstream.md, "Arrays of integers"). */

import { GAUSSIAN_COUNT, MAX_LOW_BITS } from "./constants.ts";
import type { FieldReader } from "./fields.ts";
import type { Kernels } from "./kernels.ts";
import { readStream } from "./streams.ts";
import { gaussianTables } from "./tables.ts";

const INT32 = 2 ** 31;

/** They are the last thing in their section: reads up to its end. */
export function readArrays(reader: FieldReader, sizes: number[], kernels: Kernels): Int32Array[] {
  const tables: number[] = [];
  const lowBits: number[] = [];
  sizes.forEach((_, i) => {
    const table = reader.u8(`table of array ${i}`);
    if (table >= GAUSSIAN_COUNT) reader.refuse(`table of array ${i} is ${table}`);
    const bits = reader.u8(`low_bits of array ${i}`);
    if (bits > MAX_LOW_BITS)
      reader.refuse(`low_bits of array ${i} are ${bits}, expected 0 to ${MAX_LOW_BITS}`);
    tables.push(table);
    lowBits.push(bits);
  });
  const streamBytes = reader.varint("stream_bytes", 0, reader.left);
  if (streamBytes > reader.left)
    reader.refuse(`stream_bytes are ${streamBytes}, ${reader.left} bytes are left`);
  const count = sizes.reduce((a, b) => a + b, 0);
  const streamEnd = reader.position + streamBytes;
  const choices = new Uint8Array(count);
  let first = 0;
  sizes.forEach((size, i) => choices.fill(tables[i]!, first, (first += size)));
  const bitCount = sizes.reduce((sum, size, i) => sum + size * lowBits[i]!, 0);
  if (streamEnd + Math.ceil(bitCount / 8) !== reader.bytes.length) {
    reader.refuse(
      `low parts have ${reader.bytes.length - streamEnd} bytes, expected ${Math.ceil(bitCount / 8)}`,
    );
  }
  const high = readStream(reader, gaussianTables(), choices, -INT32, INT32 - 1, kernels);
  if (reader.position !== streamEnd) reader.refuse(`the stream does not have its ${streamBytes} bytes`);
  const bits = new BitReader(reader.slice(Math.ceil(bitCount / 8), "low_parts"));
  first = 0;
  const arrays = sizes.map((size, i) => {
    const values = combine(high.subarray(first, (first += size)), lowBits[i]!, bits, reader);
    return values;
  });
  if (!bits.restIsZero()) reader.refuse("bits behind the low parts are not zero");
  return arrays;
}

function combine(high: Int32Array, lowBits: number, bits: BitReader, reader: FieldReader): Int32Array {
  const scale = 2 ** lowBits;
  const half = Math.floor(scale / 2);
  const values = new Int32Array(high.length);
  for (let i = 0; i < high.length; i++) {
    const value = high[i]! * scale + bits.take(lowBits) - half;
    if (value < -INT32 || value >= INT32)
      reader.refuse(`an element is ${value}, which has more than 32 bits`);
    values[i] = value;
  }
  return values;
}

/** Bits of bytes, most significant first. */
class BitReader {
  private position = 0;

  constructor(private readonly bytes: Uint8Array) {}

  take(count: number): number {
    let value = 0;
    for (let i = 0; i < count; i++) {
      value = 2 * value + ((this.bytes[this.position >> 3]! >> (7 - (this.position & 7))) & 1);
      this.position++;
    }
    return value;
  }

  restIsZero(): boolean {
    if ((this.position & 7) === 0) return true;
    return (this.bytes[this.position >> 3]! & (0xff >> (this.position & 7))) === 0;
  }
}
