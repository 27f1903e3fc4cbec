/**
 * The binary arithmetic code (docs/bitstream.md, "Arithmetic code").
 *
 * `low`, `high` and `code` are 48-bit integers in doubles, which hold them exactly.
 */

const TOP = 2 ** 40;
const RANGE = 2 ** 48;

export class ArithmeticDecoder {
  private low = 0;
  private high = RANGE - 1;
  private code = 0;
  private next: number;

  constructor(
    private readonly bytes: Uint8Array,
    start: number,
  ) {
    this.next = start;
    for (let i = 0; i < 6; i++) this.code = this.code * 256 + this.nextByte();
  }

  private nextByte(): number {
    const at = this.next++;
    return at < this.bytes.length ? this.bytes[at]! : 0;
  }

  /** A decision with probability `p1` / 65536 of a 1. */
  decide(p1: number): number {
    const split = this.low + Math.floor((this.high - this.low) / 65536) * p1;
    const bit = this.code <= split ? 1 : 0;
    if (bit) this.high = split;
    else this.low = split + 1;
    let top = Math.floor(this.low / TOP);
    while (top === Math.floor(this.high / TOP)) {
      this.low = (this.low - top * TOP) * 256;
      this.high = (this.high - top * TOP) * 256 + 255;
      this.code = (this.code - top * TOP) * 256 + this.nextByte();
      top = Math.floor(this.low / TOP);
    }
    return bit;
  }

  /** Whether the code ends as an encoder ends it. */
  endsWell(): boolean {
    return this.code === (Math.floor(this.low / TOP) + 1) * TOP;
  }

  /** Place behind the code's last byte: six bytes are read ahead, of which the code has the first. */
  get end(): number {
    return this.next - 5;
  }
}
