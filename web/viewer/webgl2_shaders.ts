/** Splats as docs/bitstream_prediction.md, "Rendering", has them: one quad each, drawn from back to front. */

import { BLENDED, ELLIPSE } from "./splat_glsl.ts";
import { CUTOFF, NEAR, ROW } from "./splatting.ts";

export const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
uniform sampler2D geometry;    // planes of mean, covariance xx xy xz, covariance yy yz zz
uniform sampler2D appearance;  // color, opacity
uniform int planeRows;
uniform mat3 rotation;         // frame to camera, columns as GLSL has them
uniform vec3 translation;
uniform vec2 focal;            // pixels
uniform vec2 principal;        // pixels
uniform vec2 size;             // pixels
uniform float dilation;        // pixels^2
layout(location = 0) in uint primitive;
out vec2 place;                // standard deviations from the middle
out vec4 color;

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside, unless it is drawn
  int index = int(primitive);
  ivec2 at = ivec2(index % ${ROW}, index / ${ROW});
  color = texelFetch(appearance, at, 0);
  vec3 p = rotation * texelFetch(geometry, at, 0).xyz + translation;
  if (p.z < ${NEAR} || !(color.a > ${CUTOFF})) return;
  vec3 s0 = texelFetch(geometry, at + ivec2(0, planeRows), 0).xyz;
  vec3 s1 = texelFetch(geometry, at + ivec2(0, 2 * planeRows), 0).xyz;
  mat3 covariance = mat3(s0.x, s0.y, s0.z, s0.y, s1.x, s1.y, s0.z, s1.y, s1.z);
  mat3 turn = rotation;
${ELLIPSE}
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}`;

export const SPLAT_FRAGMENT = `#version 300 es${BLENDED}`;

export const SCREEN_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

/** What the splats let through shows the background. */
export const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
uniform vec3 background;
out vec4 result;
void main() {
  vec4 splats = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  result = vec4(splats.rgb + (1.0 - splats.a) * background, 1.0);
}`;
