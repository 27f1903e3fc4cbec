/** Splats as docs/bitstream_prediction.md, "Rendering", has them, for the matrices of three.js: one quad each. */

import { CUTOFF, MARGIN, MOST_ALPHA, NEAR, ROW } from "../viewer/splatting.ts";

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
  vec2 widened = ${MARGIN} * size / focal;
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
  vec2 clip = 2.0 * pixel / size - 1.0;
  vec4 middle = projectionMatrix * seen;  // the depth of its middle: splats lie behind other things, or before them
  gl_Position = vec4(clip.x, -clip.y, middle.z / middle.w, 1.0);
}`;

export const FRAGMENT = /* glsl */ `
precision highp float;
in vec2 place;
in vec4 color;
out vec4 result;
void main() {
  float alpha = min(${MOST_ALPHA}, color.a * exp(-0.5 * dot(place, place)));
  if (alpha < ${CUTOFF}) discard;
  result = vec4(color.rgb * alpha, alpha);
}`;
