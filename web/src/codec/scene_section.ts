/** The scene section: how much of everything there is, and in what units. */

import {
  FIRST_WITH_DILATION,
  FIRST_WITH_NEIGHBOURS,
  LARGEST,
  LARGEST_DILATION,
  LOG_SCALES,
  MAX_ANCHORS,
  MAX_COUPLED_PRIMITIVES,
  MAX_GROUPS,
  MAX_REFERENCE_DIM,
  MAX_RESIDUAL_DIM,
  MAX_SIDE_DIM,
  MAX_TABLES,
  MAX_WIDTH,
  SMALLEST,
  SMALLEST_DILATION,
} from "./constants.ts";
import { FieldReader } from "./fields.ts";
import { NEIGHBOUR_INPUTS } from "./neighbours.ts";

export const Role = { side: 0, reference: 1, logScales: 2, residual: 3 } as const;

/** Layouts of the prediction heads, by their numbers in the file. */
const HEADS = ["separate", "paired", "shallow"] as const;
export type HeadsName = (typeof HEADS)[number];

const CHANNEL_LIMITS = [MAX_SIDE_DIM, MAX_REFERENCE_DIM, LOG_SCALES, MAX_RESIDUAL_DIM];

/** Latents that are coded together. */
export interface GroupShape {
  role: number;
  /** Of an anchor; with role residual of a coupled primitive. */
  channels: number;
  /** Whether its network takes the anchor's coordinates. */
  seesCoordinates: boolean;
  /** Groups whose latents its network takes, ascending. */
  context: number[];
  /** Whether its network takes what the anchor's neighbours have of this group, and its means follow it. */
  seesNeighbours: boolean;
  /** Quantization steps: none (role side), one, or one for each channel. */
  steps: number[];
  /** Symbols of an anchor that has all its coupled primitives. */
  width: number;
  /** Numbers that its network takes for an anchor. */
  inputs: number;
  hasNetwork: boolean;
}

export interface SceneSection {
  anchors: number;
  coupled: number;
  coupledPrimitives: number;
  residualDim: number;
  referenceDim: number;
  heads: HeadsName;
  width: number;
  voxelSize: number;
  worldOffset: [number, number, number];
  viewDistanceScale: number;
  background: [number, number, number];
  angularDilation: number | null;
  groups: GroupShape[];
}

export function readScene(payload: Uint8Array, name: string, version: number): SceneSection {
  const reader = new FieldReader(payload, name);
  const between = (what: string, value: number, least: number, most: number): number => {
    if (!(value >= least && value <= most))
      reader.refuse(`${what} is ${value}, expected ${least} to ${most}`);
    return value;
  };
  const upTo = (what: string, value: number): number => between(what, value, -LARGEST, LARGEST);
  const anchors = between("anchors", reader.u32("anchors"), 1, MAX_ANCHORS);
  const coupled = reader.u32("coupled");
  const coupledPrimitives = between(
    "coupled_primitives",
    reader.u8("coupled_primitives"),
    1,
    MAX_COUPLED_PRIMITIVES,
  );
  between("coupled", coupled, 0, anchors * coupledPrimitives);
  const residualDim = between("residual_dim", reader.u8("residual_dim"), 1, MAX_RESIDUAL_DIM);
  const heads = HEADS[between("heads", reader.u8("heads"), 0, HEADS.length - 1)]!;
  const width = between("width", reader.u16("width"), 1, MAX_WIDTH);
  const voxelSize = between("voxel_size", reader.f64("voxel_size"), SMALLEST, LARGEST);
  const offset = () => upTo("world_offset", reader.f64("world_offset"));
  const worldOffset: [number, number, number] = [offset(), offset(), offset()];
  const viewDistanceScale = between(
    "view_distance_scale",
    reader.f64("view_distance_scale"),
    SMALLEST,
    LARGEST,
  );
  const color = () => upTo("background", reader.f32("background"));
  const background: [number, number, number] = [color(), color(), color()];
  const dilation = (): number =>
    between("angular_dilation", reader.f32("angular_dilation"), SMALLEST_DILATION, LARGEST_DILATION);
  const angularDilation = version < FIRST_WITH_DILATION ? null : dilation();
  const count = between("groups", reader.u8("groups"), 1, MAX_GROUPS);
  const groups: GroupShape[] = [];
  for (let i = 0; i < count; i++) groups.push(readGroup(reader, version, groups, coupledPrimitives));
  reader.end();
  const referenceDim = between(
    "reference channels",
    channelsOf(groups, Role.reference),
    1,
    MAX_REFERENCE_DIM,
  );
  between("log scale channels", channelsOf(groups, Role.logScales), LOG_SCALES, LOG_SCALES);
  const residuals = channelsOf(groups, Role.residual);
  if (residuals) between("residual channels", residuals, residualDim, residualDim);
  return {
    anchors,
    coupled,
    coupledPrimitives,
    residualDim,
    referenceDim,
    heads,
    width,
    voxelSize,
    worldOffset,
    viewDistanceScale,
    background,
    angularDilation,
    groups,
  };
}

/** Channels of all groups of a role together. */
export function channelsOf(groups: GroupShape[], role: number): number {
  return groups.reduce((sum, group) => sum + (group.role === role ? group.channels : 0), 0);
}

function readGroup(
  reader: FieldReader,
  version: number,
  before: GroupShape[],
  coupledPrimitives: number,
): GroupShape {
  const index = before.length;
  const role = reader.varint(`role of group ${index}`, 0, 3);
  const channels = reader.varint(`channels of group ${index}`, 1, CHANNEL_LIMITS[role]!);
  const bitCount = version < FIRST_WITH_NEIGHBOURS ? index + 1 : index + 2;
  const bits = reader.varint(`context of group ${index}`, 0, 2 ** bitCount - 1);
  const stepCount = reader.varint(`steps of group ${index}`, 0, channels);
  const isLegal = role === Role.side ? stepCount === 0 : stepCount === 1 || stepCount === channels;
  if (!isLegal) reader.refuse(`group ${index} of role ${role} has ${stepCount} steps`);
  const steps: number[] = [];
  for (let i = 0; i < stepCount; i++) {
    const step = reader.f32(`step of group ${index}`);
    if (!(step >= SMALLEST && step <= LARGEST)) reader.refuse(`step of group ${index} is ${step}`);
    steps.push(step);
  }
  const context = before.map((_, j) => j).filter((j) => (bits >> (j + 1)) & 1);
  const residual = context.find((j) => before[j]!.role === Role.residual);
  if (residual !== undefined)
    reader.refuse(`group ${index} takes group ${residual}, whose latents are residuals`);
  const seesNeighbours = ((bits >> (index + 1)) & 1) === 1;
  if (seesNeighbours && role === Role.residual)
    reader.refuse(`group ${index} takes what neighbours have, and its latents are residuals`);
  const width = role === Role.residual ? channels * coupledPrimitives : channels;
  const hasNetwork = bits !== 0;
  if (!hasNetwork && width > MAX_TABLES)
    reader.refuse(`group ${index} needs ${width} tables, at most ${MAX_TABLES}`);
  const seesCoordinates = (bits & 1) === 1;
  const inputs =
    (seesCoordinates ? 3 : 0) +
    context.reduce((sum, j) => sum + before[j]!.channels, 0) +
    (seesNeighbours ? NEIGHBOUR_INPUTS : 0);
  return { role, channels, seesCoordinates, context, seesNeighbours, steps, width, inputs, hasNetwork };
}
