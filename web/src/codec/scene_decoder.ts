/**
 * A file becomes a scene, range by range: what comes before the latents is decoded once, then each section of latents
 * adds its anchors without touching those that are there.
 */

import { CorruptSection, MissingDependency } from "../errors.ts";
import { wasmKernels } from "../wasm_kernels.ts";
import { canonicalOrder, standsFor } from "./anchor_order.ts";
import { type Section, SectionNumber } from "./container.ts";
import { FieldReader } from "./fields.ts";
import { type Tensor, readHeads } from "./heads.ts";
import {
  type EarlierRanges,
  type GroupLatents,
  type RangeHead,
  concatenate,
  readRange,
  readRangeHead,
} from "./latents.ts";
import { checkFlags, checkHeadProducts, checkNetworkProducts, checkSymbols, mostNodes } from "./limits.ts";
import { readMasks } from "./masks.ts";
import { checkPadding, readMetadata } from "./metadata.ts";
import { EarlierAnchors } from "./neighbours.ts";
import { type IntegerNetwork, readNetworks } from "./networks.ts";
import { readPositions } from "./positions.ts";
import { type GroupShape, type HeadsName, type SceneSection, readScene } from "./scene_section.ts";
import { type FrequencyTables, readTables } from "./tables.ts";
import { type Viewpoints, readViewpoints } from "./viewpoints.ts";

/** Latents of a group, of all anchors that are there. */
export interface SceneGroup extends GroupShape, GroupLatents {}

/** The decoded integers of a file, or of its beginning. */
export interface Scene {
  /** Anchors that are there, and coupled primitives that exist of these. */
  anchors: number;
  coupled: number;
  /** Those of the whole file. */
  totalAnchors: number;
  totalCoupled: number;
  coupledPrimitives: number;
  residualDim: number;
  referenceDim: number;
  heads: HeadsName;
  width: number;
  /** World units between neighbouring coordinates. */
  voxelSize: number;
  /** World units: where coordinates (0, 0, 0) are. Everything else is in the local frame, world minus this. */
  worldOffset: [number, number, number];
  viewDistanceScale: number;
  background: [number, number, number];
  /**
   * What is added to the variances of splats in a picture, as the square of an angle's tangent; null: the same pixels
   * in pictures of every size.
   */
  angularDilation: number | null;
  /** Octree levels. */
  depth: number;
  /** [anchors, 3] in canonical order */
  coordinates: Int32Array;
  /** [anchors, coupledPrimitives] 1 where a coupled primitive exists */
  mask: Uint8Array;
  groups: SceneGroup[];
  tensors: Map<string, Tensor>;
  ranges: RangeHead[];
  /** [anchors] of how many anchors of the whole file each stands for; null if all are there. */
  standsFor: Int32Array | null;
  viewpoints: Viewpoints | null;
  metadata: Map<string, string>;
}

export class SceneDecoder {
  private readonly section: SceneSection;
  private readonly depth: number;
  /** Of all anchors of the file, in canonical order. */
  private readonly offsets: Int32Array;
  private readonly coordinates: Int32Array;
  private readonly mortonRank: Int32Array;
  private readonly upToLevel: number[];
  private readonly mask: Uint8Array;
  private readonly tables: Array<FrequencyTables | null>;
  private readonly networks: Array<IntegerNetwork | null>;
  private readonly networkWeights: number;
  private readonly tensors: Map<string, Tensor>;
  private readonly headElements: number;
  private readonly ranges: RangeHead[] = [];
  private readonly pieces: GroupLatents[][] = [];
  private anchors = 0;
  /** Coupled primitives that are there. */
  coupled = 0;
  private readonly kernels = wasmKernels();
  private viewpoints: Viewpoints | null = null;
  private metadata = new Map<string, string>();

  /**
   * Decodes what comes before the latents.
   *
   * `bytes`: length of the file, or of what has arrived of it; `whole`: whether all anchors will be decoded.
   */
  constructor(version: number, sections: Section[], bytes: number, whole: boolean) {
    const { kernels } = this;
    const find = (number: number): Section | undefined => sections.find((s) => s.number === number);
    const [scene, positions, masks] = [SectionNumber.scene, SectionNumber.positions, SectionNumber.masks].map(
      find,
    );
    const [tables, networks, heads] = [SectionNumber.tables, SectionNumber.networks, SectionNumber.heads].map(
      find,
    );
    this.section = readScene(scene!.payload, scene!.name, version);
    const { anchors, coupled, coupledPrimitives, groups } = this.section;
    if (whole) checkSymbols(anchors, groups, bytes);
    checkFlags(anchors, coupledPrimitives, bytes);
    this.tables = readTables(tables!.payload, groups, tables!.name, kernels);
    const read = readNetworks(networks!.payload, groups, networks!.name, version, kernels);
    this.networks = read.networks;
    this.networkWeights = read.weights;
    if (whole) checkNetworkProducts(anchors, read.weights, bytes);
    this.tensors = readHeads(heads!.payload, this.section, heads!.name, version, kernels);
    this.headElements = [...this.tensors.values()].reduce((sum, tensor) => sum + tensor.values.length, 0);
    if (whole) checkHeadProducts(coupled, this.headElements, bytes);
    if (!positions) {
      throw new MissingDependency(
        "positions (G-PCC): this decoder has no G-PCC; write the file with octree positions",
      );
    }
    const found = readPositions(positions.payload, anchors, mostNodes(bytes), positions.name, kernels);
    this.depth = found.depth;
    const order = canonicalOrder(found.offsets, found.depth);
    this.offsets = order.offsets;
    this.mortonRank = order.mortonRank;
    this.upToLevel = order.upToLevel;
    this.coordinates = order.offsets.map((offset, i) => offset + found.origin[i % 3]!);
    this.mask = readMasks(masks!.payload, anchors, coupledPrimitives, masks!.name, kernels);
    const exist = countOnes(this.mask);
    if (exist !== coupled) {
      throw new CorruptSection(`masks: ${exist} coupled primitives, the scene section says ${coupled}`);
    }
    this.addOptional(sections);
  }

  /** Sections that may come late: viewpoints, metadata, padding. */
  addOptional(sections: Section[]): void {
    for (const { number, payload, name } of sections) {
      if (number === SectionNumber.viewpoints) this.viewpoints = readViewpoints(payload, name);
      else if (number === SectionNumber.metadata) this.metadata = readMetadata(payload, name);
      else if (number === SectionNumber.padding) checkPadding(payload, name);
    }
  }

  /** Adds the anchors of one more section of latents; `bytes` of the file have arrived. */
  addRange(section: Section, bytes: number): void {
    const reader = new FieldReader(section.payload, section.name);
    const head = readRangeHead(reader);
    const { groups, coupledPrimitives } = this.section;
    this.checkHead(head, reader);
    checkSymbols(this.anchors + head.anchors, groups, bytes);
    checkNetworkProducts(this.anchors + head.anchors, this.networkWeights, bytes);
    checkHeadProducts(this.coupled + head.coupled, this.headElements, bytes);
    const [first, end] = [this.anchors, this.anchors + head.anchors];
    const range = {
      count: head.anchors,
      offsets: this.offsets.subarray(3 * first, 3 * end),
      depth: this.depth,
      mask: this.mask.subarray(coupledPrimitives * first, coupledPrimitives * end),
      slots: coupledPrimitives,
      coupled: head.coupled,
      earlier: this.earlierRanges(),
    };
    this.pieces.push(readRange(reader, groups, this.tables, this.networks, range, this.kernels));
    this.ranges.push(head);
    this.anchors = end;
    this.coupled += head.coupled;
  }

  private earlierRanges(): EarlierRanges | null {
    if (!this.ranges.length) return null;
    const offsets = this.offsets.subarray(0, 3 * this.anchors);
    return { anchors: new EarlierAnchors(offsets, this.depth - this.level), pieces: this.pieces };
  }

  private checkHead(head: RangeHead, reader: FieldReader): void {
    const before = this.ranges[this.ranges.length - 1]?.level ?? -1;
    if (head.level <= before || head.level > this.depth) {
      reader.refuse(`level is ${head.level}, expected ${before + 1} to ${this.depth}`);
    }
    const anchors = this.upToLevel[head.level]! - this.anchors;
    if (head.anchors !== anchors)
      reader.refuse(`range_anchors is ${head.anchors}, the positions have ${anchors}`);
    const slots = this.section.coupledPrimitives;
    const coupled = countOnes(this.mask.subarray(slots * this.anchors, slots * (this.anchors + anchors)));
    if (head.coupled !== coupled)
      reader.refuse(`range_coupled is ${head.coupled}, the masks have ${coupled}`);
  }

  /** Refuses a file whose ranges leave anchors out. */
  checkComplete(): void {
    if (this.anchors !== this.section.anchors) {
      throw new CorruptSection(`latents: level of the last section is ${this.level}, expected ${this.depth}`);
    }
  }

  get level(): number {
    return this.ranges[this.ranges.length - 1]?.level ?? -1;
  }

  get isComplete(): boolean {
    return this.anchors === this.section.anchors;
  }

  /** What has been decoded so far. */
  scene(): Scene {
    const { section, anchors } = this;
    return {
      ...section,
      anchors,
      coupled: this.coupled,
      totalAnchors: section.anchors,
      totalCoupled: section.coupled,
      depth: this.depth,
      coordinates: this.coordinates.subarray(0, 3 * anchors),
      mask: this.mask.subarray(0, section.coupledPrimitives * anchors),
      groups: section.groups.map((group, i) => ({
        ...group,
        symbols: concatenate(this.pieces.map((piece) => piece[i]!.symbols)),
        latents: concatenate(this.pieces.map((piece) => piece[i]!.latents)),
      })),
      tensors: this.tensors,
      ranges: [...this.ranges],
      standsFor: this.isComplete ? null : standsFor(this.mortonRank, anchors),
      viewpoints: this.viewpoints,
      metadata: this.metadata,
    };
  }
}

function countOnes(mask: Uint8Array): number {
  let count = 0;
  for (let i = 0; i < mask.length; i++) count += mask[i]!;
  return count;
}
