/** The kernels in WebAssembly (assembly/). */

import kernelBytes from "compgs:kernels";
import { CONFIDENCE, RATE, SQUASH, STRETCH } from "./codec/arithmetic_tables.ts";
import type { CoupledTask, Kernels, PackedMLP } from "./codec/kernels.ts";
import { type IntegerLayer, type IntegerNetwork, clampActivation } from "./codec/networks.ts";
import {
  AROUND_HIGH,
  AROUND_LOW,
  FACES,
  OCCUPIED_HIGH,
  OCCUPIED_LOW,
  STEP_CHILD,
  STEP_NODE,
  TOUCHING,
} from "./codec/octree_grid.ts";
import { rowTables } from "./codec/rows.ts";
import { CorruptSection, MissingDependency } from "./errors.ts";

interface Exports {
  memory: WebAssembly.Memory;
  alloc(bytes: number): number;
  mark(): number;
  release(to: number): void;
  setTables(...tables: number[]): void;
  setGrid(...tables: number[]): void;
  setRowTables(...tables: number[]): void;
  walkOctree(...arguments_: number[]): number;
  decodeMasks(...arguments_: number[]): number;
  decodeChunk(...arguments_: number[]): number;
  applyLayer(...arguments_: number[]): void;
  runCoupled(...arguments_: number[]): void;
}

type Numbers = Uint8Array | Uint16Array | Int32Array | Float32Array | Float64Array;

const CHUNK_PROBLEMS = [
  "",
  "the words of a chunk end before its symbols",
  "words of a chunk are left over",
  "a state of the entropy coder begins out of range",
  "a state of the entropy coder does not end where it began",
];

let made: Kernels | undefined;

/** The kernels of this thread, made with the first call. Throws MissingDependency without WebAssembly or its vectors. */
export function wasmKernels(): Kernels {
  made ??= new WasmKernels(compiled().exports as unknown as Exports);
  return made;
}

function compiled(): WebAssembly.Instance {
  const env = {
    abort(): never {
      throw new Error("the kernels ran out of memory");
    },
  };
  try {
    // At once, as they are small: only Chrome before version 114 refuses it, and in a page's main thread alone.
    return new WebAssembly.Instance(new WebAssembly.Module(kernelBytes), { env });
  } catch (error) {
    const found = error instanceof Error ? error.message : String(error);
    throw new MissingDependency(
      `kernels: decoding needs WebAssembly with vectors, which this browser or the page's policy does not give ` +
        `(${found}). A Content-Security-Policy must allow 'wasm-unsafe-eval'`,
    );
  }
}

class WasmKernels implements Kernels {
  constructor(private readonly wasm: Exports) {
    wasm.setTables(this.put(SQUASH), this.put(STRETCH), this.put(RATE), this.put(CONFIDENCE));
    const pairs = (low: Int32Array, high: Int32Array): Int32Array =>
      Int32Array.from({ length: 2 * low.length }, (_, i) => (i & 1 ? high : low)[i >> 1]!);
    wasm.setGrid(
      this.put(pairs(OCCUPIED_LOW, OCCUPIED_HIGH)),
      this.put(pairs(AROUND_LOW, AROUND_HIGH)),
      this.put(FACES),
      this.put(TOUCHING),
      this.put(STEP_NODE),
      this.put(STEP_CHILD),
    );
    const { expected, seen, seenBase, ratios } = rowTables();
    wasm.setRowTables(this.put(expected), this.put(seen), this.put(seenBase), this.put(ratios));
  }

  walkOctree(
    payload: Uint8Array,
    start: number,
    anchors: number,
    depth: number,
    mostNodes: number,
    section: string,
  ) {
    return this.within(() => {
      const at = this.put(payload);
      const out = this.wasm.alloc(12 * anchors);
      const most = Math.min(mostNodes, 2 ** 31 - 1);
      const end = this.wasm.walkOctree(at, start, payload.length, anchors, depth, most, out);
      if (end === -3)
        throw new CorruptSection(`${section}: more than ${mostNodes} nodes, the most for this file`);
      if (end === -2) throw new CorruptSection(`${section}: the octree does not hold ${anchors} anchors`);
      checkEnd(end, section);
      return { offsets: new Int32Array(this.wasm.memory.buffer, out, 3 * anchors).slice(), end };
    });
  }

  decodeMasks(payload: Uint8Array, anchors: number, slots: number, section: string) {
    return this.within(() => {
      const at = this.put(payload);
      const out = this.wasm.alloc(anchors * slots);
      const end = this.wasm.decodeMasks(at, payload.length, anchors, slots, out);
      checkEnd(end, section);
      return { mask: new Uint8Array(this.wasm.memory.buffer, out, anchors * slots).slice(), end };
    });
  }

  decodeChunk: Kernels["decodeChunk"] = (words, tables, choices, symbols, rows, section) => {
    this.within(() => {
      const { base, entries, lowest, frequencies, cumulated, hints } = tables;
      const places = [base, entries, lowest, frequencies, cumulated, hints].map((table) => this.put(table));
      const chosen = this.put(choices);
      const out = this.wasm.alloc(4 * symbols.length);
      const problem = this.wasm.decodeChunk(
        this.put(words),
        words.length,
        ...places,
        chosen,
        out,
        symbols.length,
        rows?.channels ?? 0,
        rows?.inertia ?? 0,
        rows?.first ?? 0,
      );
      if (problem) throw new CorruptSection(`${section}: ${CHUNK_PROBLEMS[problem]}`);
      symbols.set(new Int32Array(this.wasm.memory.buffer, out, symbols.length));
      if (rows) choices.set(new Uint8Array(this.wasm.memory.buffer, chosen, choices.length));
    });
  };

  evaluate(network: IntegerNetwork, inputs: Int32Array, rows: number): Int32Array {
    return this.within(() => {
      // Rows are as wide as the widest of inputs and padded outputs, and what `skip` puts side by side.
      const widest = Math.max(...network.layers.map((layer) => Math.max(layer.inputs, layer.outputs)));
      const stride = evened(widest);
      const buffers = [0, 1, 2].map(() => this.wasm.alloc(8 * stride * rows));
      const input = Float64Array.from(inputs, clampActivation);
      this.spread(buffers[0]!, stride, input, network.inputs, rows, 0);
      let [taken, current, free] = buffers as [number, number, number];
      [taken, current] = [current, taken];
      network.layers.forEach((layer, i) => {
        const isLast = i === network.layers.length - 1;
        if (isLast && network.skip) {
          this.spread(current, stride, input, network.inputs, rows, layer.inputs - network.inputs);
        }
        this.applyLayer(layer, current, free, taken, stride, rows);
        [taken, current, free] = [current, free, taken];
      });
      return this.gather(current, stride, network.outputs, rows);
    });
  }

  private applyLayer(
    layer: IntegerLayer,
    x: number,
    y: number,
    taken: number,
    stride: number,
    rows: number,
  ): void {
    const { inputs, outputs, shift, rectify, adds } = layer;
    this.within(() => {
      const padded = evened(outputs);
      const weight = new Float64Array(inputs * padded);
      for (let o = 0; o < outputs; o++) {
        for (let i = 0; i < inputs; i++) weight[i * padded + o] = layer.weight[o * inputs + i]!;
      }
      const bias = new Float64Array(padded);
      bias.set(layer.bias);
      const added = adds ? taken : 0;
      const places = [this.put(weight), this.put(bias), inputs, padded, shift, rectify ? 1 : 0] as const;
      this.wasm.applyLayer(...places, x, stride, y, stride, added, stride, rows);
    });
  }

  runCoupled(mlp: PackedMLP, task: CoupledTask): Float32Array {
    return this.within(() => {
      const { anchors, firstCoupled, slots, residuals, residualDim } = task;
      const coupled = firstCoupled[anchors]!;
      const out = this.wasm.alloc(4 * coupled * mlp.outputs);
      this.wasm.runCoupled(
        anchors,
        mlp.width,
        mlp.padded,
        mlp.outputs,
        mlp.blockCount,
        this.put(task.entries),
        this.put(task.skips),
        this.put(firstCoupled),
        slots ? this.put(slots) : 0,
        this.put(mlp.ownEntry),
        this.put(mlp.ownSkip),
        residuals ? this.put(residuals) : 0,
        residualDim,
        this.put(mlp.blocks),
        this.put(mlp.outputWeight),
        out,
      );
      return new Float32Array(this.wasm.memory.buffer, out, coupled * mlp.outputs).slice();
    });
  }

  /** What is allocated meanwhile is free again afterwards. */
  private within<T>(work: () => T): T {
    const mark = this.wasm.mark();
    try {
      return work();
    } finally {
      this.wasm.release(mark);
    }
  }

  /** Address of a copy. */
  private put(values: Numbers): number {
    const at = this.wasm.alloc(values.byteLength);
    const bytes = new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
    new Uint8Array(this.wasm.memory.buffer, at, bytes.length).set(bytes);
    return at;
  }

  /** Rows [rows, columns] into wider ones, from `column` on. */
  private spread(
    to: number,
    stride: number,
    from: Float64Array,
    columns: number,
    rows: number,
    column: number,
  ): void {
    const all = new Float64Array(this.wasm.memory.buffer, to, stride * rows);
    for (let row = 0; row < rows; row++) {
      for (let i = 0; i < columns; i++) all[row * stride + column + i] = from[row * columns + i]!;
    }
  }

  private gather(from: number, stride: number, columns: number, rows: number): Int32Array {
    const all = new Float64Array(this.wasm.memory.buffer, from, stride * rows);
    const result = new Int32Array(rows * columns);
    for (let row = 0; row < rows; row++) {
      for (let i = 0; i < columns; i++) result[row * columns + i] = all[row * stride + i]!;
    }
    return result;
  }
}

function evened(count: number): number {
  return count + (count & 1);
}

function checkEnd(end: number, section: string): void {
  if (end < 0) throw new CorruptSection(`${section}: the code does not end as an encoder ends it`);
}
