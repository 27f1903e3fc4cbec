/** .cgs files in three.js without another renderer of splats: one mesh of quads, sorted in a worker. */

import {
  BufferAttribute,
  type Camera,
  Color,
  CustomBlending,
  DataTexture,
  DoubleSide,
  FloatType,
  GLSL3,
  InstancedBufferAttribute,
  InstancedBufferGeometry,
  Matrix4,
  Mesh,
  OneFactor,
  OneMinusSrcAlphaFactor,
  type PerspectiveCamera,
  RawShaderMaterial,
  SRGBColorSpace,
  type Scene,
  UnsignedByteType,
  Vector2,
  Vector3,
  type WebGLRenderer,
} from "three";
import sorterSource from "compgs:sorter";
import { LiveScene, type Splats } from "../src/live/live_scene.ts";
import type { SceneInfo } from "../src/scene_info.ts";
import type { Source } from "../src/sources.ts";
import { geometryPlanes, rowsOf } from "../viewer/splat_planes.ts";
import { PLANES, ROW, dilationOf } from "../viewer/splatting.ts";
import type { ShownOptions } from "./options.ts";
import { FRAGMENT, VERTEX } from "./three_shaders.ts";
import type { FromSorter, ToSorter } from "./three_sorter.ts";
import { viewpointCamera, viewpointTarget } from "./three_view.ts";

export { splatBudget } from "../src/budget.ts";
export { isCgs, MEDIA_TYPE } from "../src/sources.ts";

export interface CgsSplatsOptions extends ShownOptions<CgsSplats> {
  /** Of `compgs/sorter`, for pages whose policy forbids workers from blobs. */
  sorter?: Worker;
}

/**
 * The splats of a .cgs file: coarse as soon as the first part of the file is there, then finer. Axes are the file's; the
 * origin is at `info.worldOffset`. It is drawn with WebGLRenderer and perspective cameras, after what is not transparent.
 */
export class CgsSplats extends Mesh<InstancedBufferGeometry, RawShaderMaterial> {
  /** Resolves with the first part of the file; rejects if there is none. */
  readonly initialized: Promise<this>;
  /** Resolves when all of the file is shown; rejects if it is damaged or cannot be had. */
  readonly complete: Promise<this>;
  private readonly live: LiveScene<"arrays">;
  private readonly sorter: Worker;
  /** From where the splats were last to be sorted; the same, once that order is drawn. */
  private asked: [number, number, number, number] | null = null;
  private isSorting = false;
  private isSorted = false;

  constructor(source: Source, options: CgsSplatsOptions = {}) {
    super(newQuads(), newMaterial());
    this.frustumCulled = false;
    this.visible = false; // until there are splats
    this.sorter = options.sorter ?? inlineSorter();
    this.sorter.onmessage = ({ data }: MessageEvent<FromSorter>) => this.setOrder(data.order);
    this.live = new LiveScene<"arrays">(source, {
      layout: "arrays",
      onSplats: (splats) => {
        this.setSplats(splats);
        options.onSplats?.(this);
      },
      onColors: (colors) => this.setColors(colors),
      ...(options.onProgress && { onProgress: options.onProgress }),
      ...(options.most !== undefined && { most: options.most }),
      ...(options.worker && { worker: options.worker }),
    });
    this.initialized = this.live.first.then(() => this);
    this.complete = this.live.complete.then(() => this);
    // Who waits for one of them must not answer for the other.
    for (const promise of [this.initialized, this.complete]) promise.catch(() => {});
  }

  /** Of what is there so far, null before the first scene. */
  get info(): SceneInfo | null {
    return this.live.info;
  }

  /** Whether colors and order are those of the camera of the last frame. */
  get isSettled(): boolean {
    return this.live.isSettled && this.isSorted && !this.isSorting;
  }

  /** A camera at one of the file's viewpoints, that sees all of its picture; its `up` is the scene's, for controls. */
  camera(view = 0, aspect = 1): PerspectiveCamera {
    return viewpointCamera(this, this.known(), view, aspect);
  }

  /** What controls turn about, from one of the file's viewpoints. */
  target(view = 0): Vector3 {
    return viewpointTarget(this, this.known(), view);
  }

  dispose(): void {
    this.live.dispose();
    this.sorter.terminate();
    for (const name of ["splats", "colors"]) (this.material.uniforms[name]!.value as DataTexture).dispose();
    this.material.dispose();
    this.geometry.dispose();
  }

  /** three.js calls it with each picture. */
  override onBeforeRender = (renderer: WebGLRenderer, _: Scene, camera: Camera): void => {
    const { width, height } = renderer.getRenderTarget() ?? renderer.getDrawingBufferSize(new Vector2());
    const { size, dilation } = this.material.uniforms;
    (size!.value as Vector2).set(width, height);
    const projection = camera.projectionMatrix.elements;
    const [fx, fy] = [(width / 2) * projection[0]!, (height / 2) * projection[5]!];
    dilation!.value = dilationOf(this.known().angularDilation, { fx, fy });
    this.material.uniformsNeedUpdate = true;
    const seen = new Matrix4().multiplyMatrices(camera.matrixWorldInverse, this.matrixWorld);
    this.sort(seen.elements);
    const centre = new Vector3().setFromMatrixPosition(camera.matrixWorld);
    this.live.follow(this.worldToLocal(centre).toArray());
  };

  private known(): SceneInfo {
    if (!this.info) throw new Error("The file's viewpoints are not there yet: await splats.initialized.");
    return this.info;
  }

  /** Asks for the order of depths before a camera, given the matrix from splats to it. One order is made at a time. */
  private sort(e: ArrayLike<number>): void {
    const ahead: [number, number, number, number] = [-e[2]!, -e[6]!, -e[10]!, -e[14]!];
    this.isSorted = this.asked !== null && ahead.every((value, i) => value === this.asked![i]);
    if (this.isSorted || this.isSorting) return;
    this.asked = ahead;
    this.isSorting = true;
    this.post({ kind: "camera", axis: [ahead[0], ahead[1], ahead[2]], shift: ahead[3] });
  }

  private post(message: ToSorter, transfer: Transferable[] = []): void {
    this.sorter.postMessage(message, transfer);
  }

  private setOrder(order: Uint32Array): void {
    this.isSorting = false;
    const attribute = this.geometry.getAttribute("splat") as InstancedBufferAttribute;
    attribute.array.set(order);
    attribute.clearUpdateRanges();
    attribute.addUpdateRange(0, order.length);
    attribute.needsUpdate = true;
    this.geometry.instanceCount = order.length;
  }

  private setSplats({ geometry, colors }: Splats<"arrays">): void {
    const count = colors.length / 4;
    const rows = rowsOf(count);
    const { uniforms } = this.material;
    for (const name of ["splats", "colors"]) (uniforms[name]!.value as DataTexture).dispose();
    const planes = geometryPlanes({ ...geometry, sound: new Uint8Array(count) }, [0, 0, 0]);
    uniforms.splats!.value = newTexture(planes, PLANES * rows, true);
    uniforms.colors!.value = newTexture(new Uint8Array(4 * ROW * rows), rows, false);
    uniforms.planeRows!.value = rows;
    // The splats of a coarser scene are the first of the finer one: they are drawn until the sorter has all.
    const before = this.geometry;
    this.geometry = newQuads(count);
    this.geometry
      .getAttribute("splat")
      .array.set(before.getAttribute("splat").array.slice(0, before.instanceCount));
    this.geometry.instanceCount = before.instanceCount;
    before.dispose();
    this.asked = null;
    this.visible = true;
    this.post({ kind: "splats", means: geometry.means }, [geometry.means.buffer]);
    this.setColors(colors);
  }

  private setColors(colors: Uint8Array): void {
    const texture = this.material.uniforms.colors!.value as DataTexture;
    (texture.image.data as Uint8Array).set(colors);
    texture.needsUpdate = true;
  }
}

/**
 * Puts splats into a scene, with the background that they want where the scene has none. Gives a camera at the file's
 * first viewpoint.
 */
export function setStage(scene: Scene, renderer: WebGLRenderer, splats: CgsSplats): PerspectiveCamera {
  scene.background ??= new Color().setRGB(...(splats.info?.background ?? [0, 0, 0]), SRGBColorSpace);
  scene.add(splats);
  const { width, height } = renderer.getDrawingBufferSize(new Vector2());
  return splats.camera(0, width / height);
}

/** A quad for each splat, and which splat it is. */
function newQuads(count = 0): InstancedBufferGeometry {
  const geometry = new InstancedBufferGeometry();
  geometry.setIndex([0, 1, 2, 2, 1, 3]);
  // Corners are known by their numbers; three.js wants positions all the same.
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(12), 3));
  geometry.setAttribute("splat", new InstancedBufferAttribute(new Uint32Array(Math.max(1, count)), 1));
  geometry.instanceCount = 0;
  return geometry;
}

function newMaterial(): RawShaderMaterial {
  return new RawShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    glslVersion: GLSL3,
    uniforms: {
      splats: { value: newTexture(new Float32Array(4 * ROW), 1, true) },
      colors: { value: newTexture(new Uint8Array(4 * ROW), 1, false) },
      planeRows: { value: 1 },
      size: { value: new Vector2(1, 1) },
      dilation: { value: 0 },
    },
    side: DoubleSide, // quads are turned as their splats are
    transparent: true,
    depthWrite: false,
    // Colors are multiplied by alpha already.
    blending: CustomBlending,
    blendSrc: OneFactor,
    blendDst: OneMinusSrcAlphaFactor,
  });
}

/** Rows of ROW texels of four numbers. */
function newTexture(
  values: Float32Array<ArrayBuffer> | Uint8Array<ArrayBuffer>,
  rows: number,
  isFloat: boolean,
): DataTexture {
  const texture = new DataTexture(values, ROW, rows, undefined, isFloat ? FloatType : UnsignedByteType);
  texture.needsUpdate = true;
  return texture;
}

/** One address for the sorters of all scenes. */
let sorterUrl: string | null = null;

function inlineSorter(): Worker {
  sorterUrl ??= URL.createObjectURL(new Blob([sorterSource], { type: "text/javascript" }));
  return new Worker(sorterUrl);
}
