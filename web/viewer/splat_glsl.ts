/** What the shaders of the page and those for three.js have in common: a splat's ellipse in the picture, and its blending. */

import { CUTOFF, MARGIN, MOST_ALPHA } from "./splatting.ts";

/**
 * From the middle `p` (x right, y down, z ahead) and `covariance` of a splat, `turn` (its axes to the camera's), `focal`,
 * `principal` and `size` in pixels, `dilation` and `color` to `place`, in standard deviations, and `clip` of a corner.
 */
export const ELLIPSE = /* glsl */ `  vec2 widened = ${MARGIN} * size / focal;
  vec2 ratio = clamp(p.xy / p.z, -principal / focal - widened, (size - principal) / focal + widened);
  vec3 row0 = vec3(focal.x / p.z, 0.0, -focal.x * ratio.x / p.z) * turn;
  vec3 row1 = vec3(0.0, focal.y / p.z, -focal.y * ratio.y / p.z) * turn;
  vec3 c0 = covariance * row0;
  float a = dot(row0, c0) + dilation;
  float b = dot(row1, c0);
  float c = dot(row1, covariance * row1) + dilation;
  // Principal axes of the ellipse.
  float radius = length(vec2(0.5 * (a - c), b));
  float largest = 0.5 * (a + c) + radius;
  float smallest = max((a * c - b * b) / largest, dilation);  // never less, but a difference loses digits
  vec2 axis = a >= c ? vec2(largest - c, b) : vec2(b, largest - a);
  axis = radius > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  float reach = sqrt(2.0 * log(color.a / ${CUTOFF})) + 1e-3;  // where alpha falls below the cutoff
  place = reach * (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0);
  vec2 pixel = focal * p.xy / p.z + principal
    + place.x * sqrt(largest) * axis + place.y * sqrt(smallest) * vec2(-axis.y, axis.x);
  vec2 clip = 2.0 * pixel / size - 1.0;`;

/** A whole fragment shader, but for its version. */
export const BLENDED = /* glsl */ `
precision highp float;
in vec2 place;
in vec4 color;
out vec4 result;
void main() {
  float alpha = min(${MOST_ALPHA}, color.a * exp(-0.5 * dot(place, place)));
  if (alpha < ${CUTOFF}) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;
