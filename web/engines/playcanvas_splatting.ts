/** PlayCanvas draws splats as .cgs files are trained to be drawn. */

import { type AppBase, GSPLATDATA_LARGE, SHADERLANGUAGE_GLSL, ShaderChunks } from "playcanvas";
import { CUTOFF } from "../viewer/splatting.ts";
import { EDGE } from "./jacobian.ts";

/** What the engine adds to the variances of splats, and their least, as its shader has it: in half pixels, squared. */
const ENGINE_DILATION = /\+ 0\.3\b/g;
const ENGINE_LEAST_VARIANCE = /max\(mid - radius, 0\.1\)/;
const HALF_PIXELS = 4; // in a pixel^2
/** How the engine takes the Jacobian at a splat's middle: far outside of the picture that smears it across all of it. */
const ENGINE_JACOBIAN = "vec2 J2 = -J1 / vp.z * vp.xy;";
/** The same where the middle is in the picture or near it; held there beyond, as in training. */
const JACOBIAN = /* glsl */ `
  vec2 edge = ${EDGE} / abs(vec2(center.projMat00, center.projMat11));
  vec2 J2 = J1 * clamp(-vp.xy / vp.z, -edge, edge);`;
/** How far a splat reaches, half of it: sqrt(8) standard deviations. */
const ENGINE_REACH = /sqrt\(2\.0 \* (lambda[12])\)/g;
/** Times that: to where the alpha of an opaque splat is the least that is drawn. */
const REACH = Math.sqrt(-Math.log(CUTOFF) / 4);
/** Below it the engine discards by its own falloff, before ours is computed. */
const LEAST_ALPHA = 1e-5;
const UNIFORM = "compgs_dilation";

/**
 * The engine lets alpha end where a splat does, by subtracting what is left of it there. Files are trained with alpha as
 * it is. `gaussianUV` has length 1 where a splat ends; `gaussianColor` is what the fragment shader has of the splat.
 */
const falloff = (reach: number): string => /* glsl */ `
void modifySplatColor(vec2 gaussianUV, inout vec4 color) {
  color.a = gaussianColor.a * exp(${(-4 * reach * reach).toFixed(6)} * dot(gaussianUV, gaussianUV));
  if (color.a < ${CUTOFF}) color.a = 0.0;
}
`;

/**
 * Sets the splats of an application to what .cgs files want: sorted by depth, small ones kept, not rounded further, widened
 * and faded as in training. The latter with WebGL2; where the engine draws with WebGPU, its own falloff and dilation, a
 * quarter of the usual 0.3 pixels^2, stay.
 */
export function drawAsTrained(app: AppBase): void {
  const { gsplat } = app.scene;
  gsplat.antiAlias = false;
  gsplat.radialSorting = false;
  gsplat.dataFormat = GSPLATDATA_LARGE;
  gsplat.minPixelSize = 0;
  gsplat.minContribution = 0;
  gsplat.alphaClipForward = LEAST_ALPHA;
  const chunks = gsplat.material.getShaderChunks(SHADERLANGUAGE_GLSL);
  const corner = ShaderChunks.get(app.graphicsDevice, SHADERLANGUAGE_GLSL).get("gsplatCornerVS") ?? "";
  const parts = [ENGINE_DILATION, ENGINE_LEAST_VARIANCE, ENGINE_REACH];
  const isKnown = parts.every((part) => corner.match(part)) && corner.includes(ENGINE_JACOBIAN);
  if (isKnown) {
    const trained = corner
      .replaceAll(ENGINE_DILATION, `+ ${UNIFORM}`)
      .replace(ENGINE_LEAST_VARIANCE, `max(mid - radius, ${UNIFORM})`)
      .replace(ENGINE_JACOBIAN, JACOBIAN)
      .replaceAll(ENGINE_REACH, `${REACH.toFixed(6)} * sqrt(2.0 * $1)`);
    chunks.set("gsplatCornerVS", `uniform float ${UNIFORM};\n${trained}`);
  } else
    console.warn("compgs: this version of PlayCanvas has another shader: splats are a little too sharp.");
  chunks.set("gsplatModifyPS", falloff(isKnown ? REACH : 1));
  setDilation(app, 0.3);
}

/** What is added to the variances of splats in a picture, pixels^2. */
export function setDilation(app: AppBase, dilation: number): void {
  const { material } = app.scene.gsplat;
  const value = HALF_PIXELS * dilation;
  if ((material.getParameter(UNIFORM) as { data?: number } | undefined)?.data === value) return;
  material.setParameter(UNIFORM, value);
  material.update();
}
