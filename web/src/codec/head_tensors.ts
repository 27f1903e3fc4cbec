/** Which tensors the prediction heads have (docs/bitstream_prediction.md, "Networks of the prediction"). */

import { type SceneSection, Role, channelsOf } from "./scene_section.ts";

/** Numbers of the view embedding: a direction and a distance. */
export const VIEW = 4;
export const SHARED_RESIDUALS = "residuals";

export interface HeadLayout {
  seesView: boolean;
  outputs: number;
  blocks: number;
}

/** Of each layout its networks by name, in the order of the file. */
export const HEAD_LAYOUTS: Record<SceneSection["heads"], Record<string, HeadLayout>> = {
  separate: {
    translation: { seesView: false, outputs: 3, blocks: 1 },
    covariance: { seesView: false, outputs: 7, blocks: 1 },
    opacity: { seesView: true, outputs: 1, blocks: 1 },
    color: { seesView: true, outputs: 3, blocks: 2 },
  },
  paired: {
    geometry: { seesView: false, outputs: 10, blocks: 1 },
    appearance: { seesView: true, outputs: 4, blocks: 1 },
  },
  shallow: {
    geometry: { seesView: false, outputs: 10, blocks: 0 },
    appearance: { seesView: true, outputs: 4, blocks: 0 },
  },
};

export interface TensorShape {
  name: string;
  shape: number[];
}

/** What tensors depend on. */
type HeadSizes = Pick<
  SceneSection,
  "heads" | "width" | "referenceDim" | "residualDim" | "coupledPrimitives" | "groups"
>;

/** Name and shape of every tensor, in the order of files that leave the names out. */
export function headTensors(scene: HeadSizes): TensorShape[] {
  const tensors = Object.entries(HEAD_LAYOUTS[scene.heads]).flatMap(([name, layout]) =>
    networkTensors(name, layout, scene),
  );
  const isShared = channelsOf(scene.groups, Role.residual) === 0;
  if (isShared) tensors.push({ name: SHARED_RESIDUALS, shape: [scene.coupledPrimitives, scene.residualDim] });
  return tensors;
}

/** Numbers that a network of the heads takes. */
export function headInputs({ seesView }: HeadLayout, scene: HeadSizes): number {
  return scene.referenceDim + (seesView ? VIEW : 0) + scene.residualDim;
}

function networkTensors(network: string, layout: HeadLayout, scene: HeadSizes): TensorShape[] {
  const { width } = scene;
  const { outputs, blocks } = layout;
  const inputs = headInputs(layout, scene);
  const shapes: Record<string, number[]> = {
    input_weight: [inputs, width],
    input_bias: [width],
    output_weight: [width, outputs],
    output_bias: [outputs],
    skip_weight: [inputs, outputs],
  };
  for (let b = 0; b < blocks; b++) {
    shapes[`blocks.${b}.weight1`] = [width, width];
    shapes[`blocks.${b}.bias1`] = [width];
    shapes[`blocks.${b}.weight2`] = [width, width];
    shapes[`blocks.${b}.bias2`] = [width];
  }
  return Object.entries(shapes).map(([name, shape]) => ({ name: `${network}.${name}`, shape }));
}
