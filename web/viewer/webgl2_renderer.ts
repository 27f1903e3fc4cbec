/** Draws splats with WebGL2. Sums are kept in 16-bit floats where the browser can: 8 bits lose faint splats. */

import { CannotDraw, type FrameCamera, type Renderer, runsOf, tooManySplats } from "./renderer.ts";
import { PLANES, ROW, dilationOf } from "./splatting.ts";
import { SCREEN_FRAGMENT, SCREEN_VERTEX, SPLAT_FRAGMENT, SPLAT_VERTEX } from "./webgl2_shaders.ts";

export class WebGL2Renderer implements Renderer {
  readonly name = "webgl2";
  readonly canvas = document.createElement("canvas");
  readonly lost: Promise<string>;
  background: [number, number, number] = [0, 0, 0];
  angularDilation: number | null = null;
  private readonly gl: WebGL2RenderingContext;
  private readonly splats: WebGLProgram;
  private readonly screen: WebGLProgram;
  private readonly order: WebGLBuffer;
  private readonly vertices: WebGLVertexArrayObject;
  private readonly target: WebGLFramebuffer;
  private readonly isFloat: boolean;
  private geometry: WebGLTexture | null = null;
  private appearance: WebGLTexture | null = null;
  private picture: WebGLTexture | null = null;
  private pictureSize: [number, number] = [0, 0];
  private rows = 0;
  private drawn = 0;

  /** Throws CannotDraw where the browser has no WebGL2. */
  constructor() {
    const { canvas } = this;
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
    if (!gl) throw new CannotDraw("this browser has no WebGL2");
    this.gl = gl;
    this.lost = new Promise((resolve) => {
      canvas.addEventListener("webglcontextlost", () => resolve("the context is lost"));
    });
    this.isFloat = gl.getExtension("EXT_color_buffer_float") !== null;
    this.splats = link(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = link(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.order = gl.createBuffer()!;
    this.target = gl.createFramebuffer()!;
    this.vertices = gl.createVertexArray()!;
    gl.bindVertexArray(this.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.bindVertexArray(null);
  }

  reserve(rows: number): void {
    const { gl } = this;
    const most = gl.getParameter(gl.MAX_TEXTURE_SIZE) as number;
    if (PLANES * rows > most) throw tooManySplats(Math.floor(most / PLANES) * ROW);
    gl.deleteTexture(this.geometry);
    gl.deleteTexture(this.appearance);
    this.rows = rows;
    this.drawn = 0;
    this.geometry = newTexture(gl, gl.RGBA32F, ROW, PLANES * rows);
    this.appearance = newTexture(gl, gl.RGBA32F, ROW, rows);
  }

  setGeometry(planes: Float32Array, rows: readonly number[]): void {
    this.gl.bindTexture(this.gl.TEXTURE_2D, this.geometry);
    for (let plane = 0; plane < PLANES; plane++) {
      const first = plane * rows.length;
      this.setRows(planes, rows, first, plane * this.rows);
    }
  }

  setAppearance(values: Float32Array, rows: readonly number[]): void {
    this.gl.bindTexture(this.gl.TEXTURE_2D, this.appearance);
    this.setRows(values, rows, 0, 0);
  }

  /** Into the texture at hand, the rows of `values` from `first` on, so many rows `below` their places. */
  private setRows(values: Float32Array, rows: readonly number[], first: number, below: number): void {
    const { gl } = this;
    for (const run of runsOf(rows)) {
      const from = 4 * ROW * (first + run.at);
      gl.texSubImage2D(
        gl.TEXTURE_2D,
        0,
        0,
        below + run.first,
        ROW,
        run.count,
        gl.RGBA,
        gl.FLOAT,
        values,
        from,
      );
    }
  }

  setOrder(order: Uint32Array): void {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.drawn = order.length;
  }

  draw(camera: FrameCamera): void {
    const { gl } = this;
    const { width, height } = this.canvas;
    this.bindTarget(width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (this.drawn) this.drawSplats(camera, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(this.screen);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.picture);
    gl.uniform1i(this.at(this.screen, "picture"), 0);
    gl.uniform3fv(this.at(this.screen, "background"), this.background);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  dispose(): void {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  private drawSplats(camera: FrameCamera, width: number, height: number): void {
    const { gl, splats } = this;
    const R = camera.rotation as ArrayLike<number>;
    gl.useProgram(splats);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.geometry);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.appearance);
    gl.uniform1i(this.at(splats, "geometry"), 0);
    gl.uniform1i(this.at(splats, "appearance"), 1);
    gl.uniform1i(this.at(splats, "planeRows"), this.rows);
    gl.uniformMatrix3fv(this.at(splats, "rotation"), true, Float32Array.from(R));
    gl.uniform3fv(this.at(splats, "translation"), Float32Array.from(camera.translation));
    gl.uniform2f(this.at(splats, "focal"), camera.fx, camera.fy);
    gl.uniform2f(this.at(splats, "principal"), camera.cx, camera.cy);
    gl.uniform2f(this.at(splats, "size"), width, height);
    gl.uniform1f(this.at(splats, "dilation"), dilationOf(this.angularDilation, camera));
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.vertices);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.drawn);
    gl.bindVertexArray(null);
  }

  private bindTarget(width: number, height: number): void {
    const { gl } = this;
    if (this.pictureSize[0] !== width || this.pictureSize[1] !== height) {
      gl.deleteTexture(this.picture);
      this.picture = newTexture(gl, this.isFloat ? gl.RGBA16F : gl.RGBA8, width, height);
      this.pictureSize = [width, height];
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.picture, 0);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
  }

  private at(program: WebGLProgram, name: string): WebGLUniformLocation | null {
    return this.gl.getUniformLocation(program, name);
  }
}

function newTexture(gl: WebGL2RenderingContext, format: number, width: number, height: number): WebGLTexture {
  const texture = gl.createTexture()!;
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  }
  return texture;
}

function link(gl: WebGL2RenderingContext, vertex: string, fragment: string): WebGLProgram {
  const program = gl.createProgram()!;
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program)!.map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(
      `the viewer's shaders do not compile here: ${[gl.getProgramInfoLog(program), ...logs].join(" ")}`,
    );
  }
  return program;
}
