/**
 * The 4 x 4 x 4 cells around an octree node as two 32-bit masks, and which of them surround each child.
 *
 * Cell (x, y, z), each 0 to 3, is bit 16 x + 4 y + z: bits below 32 are in `low`, the others in `high`. The node's own
 * children are at 1 and 2 of each axis.
 */

export interface Cells {
  low: number;
  high: number;
}

const cellBit = (x: number, y: number, z: number): number => 16 * x + 4 * y + z;

function masksOf(bits: number[]): Cells {
  const cells = { low: 0, high: 0 };
  for (const bit of bits) {
    if (bit < 32) cells.low |= 1 << bit;
    else cells.high |= 1 << (bit - 32);
  }
  return cells;
}

/** Coordinates 0, 1 or 1, 2 in the grid, of the children c of the node at offset d. */
const along = (d: number, half: number): number => 1 + 2 * d + half;

/** Of neighbour j and its child c: the bit of the cell, or -1 outside of the grid. */
const CELL_OF_CHILD = new Int8Array(27 * 8);
/** Of an occupancy byte of neighbour j: bits of its occupied children within the grid. */
export const OCCUPIED_LOW = new Int32Array(27 * 256);
export const OCCUPIED_HIGH = new Int32Array(27 * 256);
for (let j = 0; j < 27; j++) {
  const d = [Math.floor(j / 9) - 1, (Math.floor(j / 3) % 3) - 1, (j % 3) - 1] as const;
  for (let c = 0; c < 8; c++) {
    const at = [along(d[0], c >> 2), along(d[1], (c >> 1) & 1), along(d[2], c & 1)] as const;
    const isInside = at.every((x) => x >= 0 && x <= 3);
    CELL_OF_CHILD[8 * j + c] = isInside ? cellBit(...at) : -1;
  }
  for (let occupancy = 0; occupancy < 256; occupancy++) {
    const children = [0, 1, 2, 3, 4, 5, 6, 7].filter((c) => (occupancy >> c) & 1);
    const cells = masksOf(children.map((c) => CELL_OF_CHILD[8 * j + c]!).filter((bit) => bit >= 0));
    OCCUPIED_LOW[256 * j + occupancy] = cells.low;
    OCCUPIED_HIGH[256 * j + occupancy] = cells.high;
  }
}

/** Of child c: the 26 cells around it, as masks. */
export const AROUND_LOW = new Int32Array(8);
export const AROUND_HIGH = new Int32Array(8);
/** Of child c: bits of the six cells that share a face with it: -x, +x, -y, +y, -z, +z. */
export const FACES = new Uint8Array(8 * 6);
/** Of child c: the seven nodes on its side: x, y, z, xy, xz, yz, xyz, as places among the 27. */
export const TOUCHING = new Uint8Array(8 * 7);
/** Of child c and direction j: which node (0 to 26) and which of its children the neighbouring cell is. */
export const STEP_NODE = new Uint8Array(8 * 27);
export const STEP_CHILD = new Uint8Array(8 * 27);

for (let c = 0; c < 8; c++) {
  const half = [c >> 2, (c >> 1) & 1, c & 1] as const;
  const around: number[] = [];
  for (let j = 0; j < 27; j++) {
    const d = [Math.floor(j / 9) - 1, (Math.floor(j / 3) % 3) - 1, (j % 3) - 1] as const;
    const cell = half.map((h, axis) => h + d[axis]!);
    const node = cell.map((x) => Math.floor(x / 2));
    const child = cell.map((x) => x & 1);
    STEP_NODE[27 * c + j] = 9 * (node[0]! + 1) + 3 * (node[1]! + 1) + node[2]! + 1;
    STEP_CHILD[27 * c + j] = 4 * child[0]! + 2 * child[1]! + child[2]!;
    if (j !== 13) around.push(cellBit(cell[0]! + 1, cell[1]! + 1, cell[2]! + 1));
  }
  const masks = masksOf(around);
  AROUND_LOW[c] = masks.low;
  AROUND_HIGH[c] = masks.high;
  const own = half.map((h) => h + 1);
  for (let face = 0; face < 6; face++) {
    const cell = own.slice();
    cell[face >> 1]! += face & 1 ? 1 : -1;
    FACES[6 * c + face] = cellBit(cell[0]!, cell[1]!, cell[2]!);
  }
  const side = half.map((h) => (h ? 1 : -1));
  const axes = [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [1, 1, 0],
    [1, 0, 1],
    [0, 1, 1],
    [1, 1, 1],
  ];
  axes.forEach((used, k) => {
    const d = used.map((u, axis) => u * side[axis]!);
    TOUCHING[7 * c + k] = 9 * (d[0]! + 1) + 3 * (d[1]! + 1) + d[2]! + 1;
  });
}
