/** The shaders of webgl2_shaders.ts in WGSL. */

import { CUTOFF, MARGIN, MOST_ALPHA, NEAR, PLANES } from "./splatting.ts";

/** 4-byte numbers of `View`, and where its fields begin. */
export const VIEW = {
  length: 28,
  rotation: [0, 4, 8],
  translation: 12,
  focal: 16,
  principal: 18,
  size: 20,
  dilation: 22,
  background: 24,
} as const;

export const SHADERS = `
struct View {
  rows: mat3x3f,           // of the rotation, frame to camera, each a column here
  translation: vec3f,
  focal: vec2f,            // pixels
  principal: vec2f,        // pixels
  size: vec2f,             // pixels
  dilation: f32,           // pixels^2
  background: vec3f,
}
struct Corner {
  @builtin(position) position: vec4f,
  @location(0) place: vec2f,   // standard deviations from the middle
  @location(1) color: vec4f,
}
// geometry: planes of mean, covariance xx xy xz, covariance yy yz zz; appearance: color, opacity
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> geometry: array<vec4f>;
@group(0) @binding(2) var<storage, read> appearance: array<vec4f>;
@group(0) @binding(3) var picture: texture_2d<f32>;

@vertex
fn splatCorner(@location(0) primitive: u32, @builtin(vertex_index) vertex: u32) -> Corner {
  var result: Corner;
  result.position = vec4f(2.0, 2.0, 2.0, 1.0);  // outside, unless it is drawn
  let color = appearance[primitive];
  result.color = color;
  let p = geometry[primitive].xyz * view.rows + view.translation;
  if (p.z < ${NEAR} || !(color.a > ${CUTOFF})) { return result; }
  let plane = arrayLength(&geometry) / ${PLANES};
  let s0 = geometry[plane + primitive].xyz;
  let s1 = geometry[2 * plane + primitive].xyz;
  let covariance = mat3x3f(s0.x, s0.y, s0.z, s0.y, s1.x, s1.y, s0.z, s1.y, s1.z);
  let focal = view.focal;
  let principal = view.principal;
  let widened = ${MARGIN} * view.size / focal;
  let ratio = clamp(p.xy / p.z, -principal / focal - widened, (view.size - principal) / focal + widened);
  let row0 = view.rows * vec3f(focal.x / p.z, 0.0, -focal.x * ratio.x / p.z);
  let row1 = view.rows * vec3f(0.0, focal.y / p.z, -focal.y * ratio.y / p.z);
  let c0 = covariance * row0;
  let a = dot(row0, c0) + view.dilation;
  let b = dot(row1, c0);
  let c = dot(row1, covariance * row1) + view.dilation;
  // Principal axes of the ellipse.
  let radius = length(vec2f(0.5 * (a - c), b));
  let largest = 0.5 * (a + c) + radius;
  let smallest = max((a * c - b * b) / largest, view.dilation);  // never less, but a difference loses digits
  var axis = vec2f(1.0, 0.0);
  if (radius > 0.0) { axis = normalize(select(vec2f(b, largest - a), vec2f(largest - c, b), a >= c)); }
  let reach = sqrt(2.0 * log(color.a / ${CUTOFF})) + 1e-3;  // where alpha falls below the cutoff
  let corner = vec2f(vec2u(vertex & 1, vertex >> 1)) * 2.0 - 1.0;
  result.place = corner * reach;
  let pixel = focal * p.xy / p.z + principal
    + result.place.x * sqrt(largest) * axis + result.place.y * sqrt(smallest) * vec2f(-axis.y, axis.x);
  let clip = 2.0 * pixel / view.size - 1.0;
  result.position = vec4f(clip.x, -clip.y, 0.0, 1.0);
  return result;
}

@fragment
fn splatColor(corner: Corner) -> @location(0) vec4f {
  let alpha = min(${MOST_ALPHA}, corner.color.a * exp(-0.5 * dot(corner.place, corner.place)));
  if (alpha < ${CUTOFF}) { discard; }
  return vec4f(corner.color.rgb * alpha, alpha);
}

@vertex
fn screenCorner(@builtin(vertex_index) vertex: u32) -> @builtin(position) vec4f {
  return vec4f(vec2f(vec2u(vertex & 1, vertex >> 1)) * 4.0 - 1.0, 0.0, 1.0);
}

// What the splats let through shows the background.
@fragment
fn screenColor(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let splats = textureLoad(picture, vec2u(at.xy), 0);
  return vec4f(splats.rgb + (1.0 - splats.a) * view.background, 1.0);
}
`;
