/** Draws splats with WebGPU. Sums are kept in 16-bit floats: 8 bits lose faint splats. */

import { CannotDraw, type FrameCamera, type Renderer, runsOf, tooManySplats } from "./renderer.ts";
import { PLANES, ROW, dilationOf } from "./splatting.ts";
import { SHADERS, VIEW } from "./webgpu_shaders.ts";

const BYTES = 16; // of a primitive in a plane, or of its color and opacity
const SUMS = "rgba16float";

/** Of the adapter, more than every device must have: how much a scene may be, and a picture. */
const LIMITS = ["maxBufferSize", "maxStorageBufferBindingSize", "maxTextureDimension2D"] as const;

interface Pipelines {
  splats: GPURenderPipeline;
  screen: GPURenderPipeline;
}

/** What is of one scene. */
interface Splats {
  geometry: GPUBuffer;
  appearance: GPUBuffer;
  bindings: GPUBindGroup;
  rows: number;
}

/** What is of one size of the picture. */
interface Picture {
  texture: GPUTexture;
  bindings: GPUBindGroup;
}

export class WebGPURenderer implements Renderer {
  readonly name = "webgpu";
  readonly lost: Promise<string>;
  background: [number, number, number] = [0, 0, 0];
  angularDilation: number | null = null;
  private readonly view: GPUBuffer;
  private splats: Splats | null = null;
  private picture: Picture | null = null;
  private order: GPUBuffer | null = null;
  private drawn = 0;

  private constructor(
    readonly canvas: HTMLCanvasElement,
    private readonly context: GPUCanvasContext,
    private readonly device: GPUDevice,
    private readonly pipelines: Pipelines,
  ) {
    this.view = device.createBuffer({
      size: 4 * VIEW.length,
      usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST,
    });
    this.lost = new Promise((resolve) => {
      void device.lost.then(({ message }) => resolve(message || "the device is lost"));
      // Among them: no memory left for a scene.
      device.onuncapturederror = ({ error }) => resolve(error.message);
    });
  }

  /** Throws CannotDraw where the browser or the device has no WebGPU. */
  static async create(): Promise<WebGPURenderer> {
    if (!navigator.gpu) throw new CannotDraw("this browser has no WebGPU");
    const adapter = await navigator.gpu.requestAdapter();
    if (!adapter) throw new CannotDraw("this browser finds no graphics device for WebGPU");
    const requiredLimits = Object.fromEntries(LIMITS.map((name) => [name, adapter.limits[name]]));
    const device = await adapter.requestDevice({ requiredLimits });
    const format = navigator.gpu.getPreferredCanvasFormat();
    const pipelines = await newPipelines(device, format);
    const canvas = document.createElement("canvas");
    const context = canvas.getContext("webgpu");
    if (!context) throw new CannotDraw("this browser has no canvas for WebGPU");
    context.configure({ device, format, alphaMode: "opaque" });
    return new WebGPURenderer(canvas, context, device, pipelines);
  }

  reserve(rows: number): void {
    const { device } = this;
    const { maxBufferSize, maxStorageBufferBindingSize } = device.limits;
    const most = Math.floor(Math.min(maxBufferSize, maxStorageBufferBindingSize) / (PLANES * BYTES));
    if (ROW * rows > most) throw tooManySplats(most);
    this.dropSplats();
    const usage = GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST;
    const geometry = device.createBuffer({ size: PLANES * BYTES * ROW * rows, usage });
    const appearance = device.createBuffer({ size: BYTES * ROW * rows, usage });
    const bindings = this.bind(this.pipelines.splats, [this.view, geometry, appearance]);
    this.splats = { geometry, appearance, bindings, rows };
  }

  setGeometry(planes: Float32Array<ArrayBuffer>, rows: readonly number[]): void {
    const { splats } = this;
    if (!splats) return;
    for (let plane = 0; plane < PLANES; plane++)
      this.setRows(splats.geometry, planes, rows, plane * rows.length, plane * splats.rows);
  }

  setAppearance(values: Float32Array<ArrayBuffer>, rows: readonly number[]): void {
    if (this.splats) this.setRows(this.splats.appearance, values, rows, 0, 0);
  }

  /** The rows of `values` from `first` on, so many rows `behind` their places. */
  private setRows(
    buffer: GPUBuffer,
    values: Float32Array<ArrayBuffer>,
    rows: readonly number[],
    first: number,
    behind: number,
  ): void {
    for (const run of runsOf(rows)) {
      const [from, count] = [4 * ROW * (first + run.at), 4 * ROW * run.count];
      this.device.queue.writeBuffer(buffer, BYTES * ROW * (behind + run.first), values, from, count);
    }
  }

  setOrder(order: Uint32Array<ArrayBuffer>): void {
    const { device } = this;
    if (!this.order || this.order.size < order.byteLength) {
      this.order?.destroy();
      this.order = device.createBuffer({
        size: order.byteLength,
        usage: GPUBufferUsage.VERTEX | GPUBufferUsage.COPY_DST,
      });
    }
    device.queue.writeBuffer(this.order, 0, order);
    this.drawn = order.length;
  }

  draw(camera: FrameCamera): void {
    const { device, pipelines, splats, drawn } = this;
    const { width, height } = this.canvas;
    device.queue.writeBuffer(this.view, 0, this.viewOf(camera, width, height));
    const picture = this.pictureOf(width, height);
    const encoder = device.createCommandEncoder();
    const sums = beginPass(encoder, picture.texture);
    if (splats && drawn) {
      sums.setPipeline(pipelines.splats);
      sums.setBindGroup(0, splats.bindings);
      sums.setVertexBuffer(0, this.order);
      sums.draw(4, drawn);
    }
    sums.end();
    const screen = beginPass(encoder, this.context.getCurrentTexture());
    screen.setPipeline(pipelines.screen);
    screen.setBindGroup(0, picture.bindings);
    screen.draw(3);
    screen.end();
    device.queue.submit([encoder.finish()]);
  }

  dispose(): void {
    this.device.destroy();
  }

  private dropSplats(): void {
    this.splats?.geometry.destroy();
    this.splats?.appearance.destroy();
    this.splats = null;
    this.drawn = 0;
  }

  private viewOf(camera: FrameCamera, width: number, height: number): Float32Array<ArrayBuffer> {
    const { rotation, translation, fx, fy, cx, cy } = camera;
    const view = new Float32Array(VIEW.length);
    VIEW.rotation.forEach((at, row) => view.set(Array.from(rotation).slice(3 * row, 3 * row + 3), at));
    view.set(translation, VIEW.translation);
    view.set([fx, fy], VIEW.focal);
    view.set([cx, cy], VIEW.principal);
    view.set([width, height], VIEW.size);
    view[VIEW.dilation] = dilationOf(this.angularDilation, camera);
    view.set(this.background, VIEW.background);
    return view;
  }

  private pictureOf(width: number, height: number): Picture {
    const old = this.picture;
    if (old && old.texture.width === width && old.texture.height === height) return old;
    old?.texture.destroy();
    const texture = this.device.createTexture({
      size: [width, height],
      format: SUMS,
      usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING,
    });
    const bindings = this.device.createBindGroup({
      layout: this.pipelines.screen.getBindGroupLayout(0),
      entries: [
        { binding: 0, resource: { buffer: this.view } },
        { binding: 3, resource: texture.createView() },
      ],
    });
    return (this.picture = { texture, bindings });
  }

  private bind(pipeline: GPURenderPipeline, buffers: GPUBuffer[]): GPUBindGroup {
    return this.device.createBindGroup({
      layout: pipeline.getBindGroupLayout(0),
      entries: buffers.map((buffer, binding) => ({ binding, resource: { buffer } })),
    });
  }
}

function beginPass(encoder: GPUCommandEncoder, texture: GPUTexture): GPURenderPassEncoder {
  return encoder.beginRenderPass({
    colorAttachments: [
      { view: texture.createView(), clearValue: [0, 0, 0, 0], loadOp: "clear", storeOp: "store" },
    ],
  });
}

async function newPipelines(device: GPUDevice, format: GPUTextureFormat): Promise<Pipelines> {
  const module = device.createShaderModule({ code: SHADERS });
  const over: GPUBlendComponent = { srcFactor: "one", dstFactor: "one-minus-src-alpha" };
  const [splats, screen] = await Promise.all([
    device.createRenderPipelineAsync({
      layout: "auto",
      vertex: {
        module,
        entryPoint: "splatCorner",
        buffers: [
          {
            arrayStride: 4,
            stepMode: "instance",
            attributes: [{ shaderLocation: 0, offset: 0, format: "uint32" }],
          },
        ],
      },
      primitive: { topology: "triangle-strip" },
      fragment: {
        module,
        entryPoint: "splatColor",
        targets: [{ format: SUMS, blend: { color: over, alpha: over } }],
      },
    }),
    device.createRenderPipelineAsync({
      layout: "auto",
      vertex: { module, entryPoint: "screenCorner" },
      fragment: { module, entryPoint: "screenColor", targets: [{ format }] },
    }),
  ]);
  return { splats, screen };
}
