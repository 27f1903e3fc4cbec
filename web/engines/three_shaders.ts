/** Splats as docs/bitstream_prediction.md, "Rendering", has them, for the matrices of three.js: one quad each. */

import { BLENDED, ELLIPSE } from "../viewer/splat_glsl.ts";
import { CUTOFF, NEAR, ROW } from "../viewer/splatting.ts";

export const VERTEX = /* glsl */ `
precision highp float;
precision highp int;
precision highp sampler2D;
uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform sampler2D splats;   // planes of mean, covariance xx xy xz, covariance yy yz zz
uniform sampler2D colors;   // color, opacity
uniform int planeRows;
uniform vec2 size;          // pixels
uniform float dilation;     // pixels^2
in uint splat;
out vec2 place;             // standard deviations from the middle
out vec4 color;

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, unless it is drawn
  ivec2 at = ivec2(int(splat) % ${ROW}, int(splat) / ${ROW});
  color = texelFetch(colors, at, 0);
  vec4 seen = modelViewMatrix * vec4(texelFetch(splats, at, 0).xyz, 1.0);
  vec3 p = vec3(seen.x, -seen.y, -seen.z);  // x right, y down, z ahead
  if (p.z < ${NEAR} || !(color.a > ${CUTOFF})) return;
  mat3 turn = mat3(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0) * mat3(modelViewMatrix);
  vec3 s0 = texelFetch(splats, at + ivec2(0, planeRows), 0).xyz;
  vec3 s1 = texelFetch(splats, at + ivec2(0, 2 * planeRows), 0).xyz;
  mat3 covariance = mat3(s0.x, s0.y, s0.z, s0.y, s1.x, s1.y, s0.z, s1.y, s1.z);
  vec2 focal = 0.5 * size * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  vec2 principal = 0.5 * size * vec2(1.0 - projectionMatrix[2][0], 1.0 + projectionMatrix[2][1]);
${ELLIPSE}
  vec4 middle = projectionMatrix * seen;  // the depth of its middle: splats lie behind other things, or before them
  gl_Position = vec4(clip.x, -clip.y, middle.z / middle.w, 1.0);
}`;

export const FRAGMENT = BLENDED;
