/** .cgs files in Spark, the renderer of splats for three.js: what Spark's own files are there, and colors that follow. */

import {
  ExtSplats,
  RgbaArray,
  SparkRenderer,
  type SparkRendererOptions,
  SplatMesh,
  utils,
} from "@sparkjsdev/spark";
import {
  Color,
  Loader,
  type LoadingManager,
  type PerspectiveCamera,
  SRGBColorSpace,
  type Scene,
  Vector2,
  type Vector3,
  type WebGLRenderer,
} from "three";
import { LiveScene, type Splats } from "../src/live/live_scene.ts";
import type { SceneInfo } from "../src/scene_info.ts";
import { type Source, isCgs } from "../src/sources.ts";
import { CUTOFF, dilationOf } from "../viewer/splatting.ts";
import { EDGE } from "./jacobian.ts";
import type { ShownOptions } from "./options.ts";
import { viewpointCamera, viewpointTarget } from "./three_view.ts";

export { splatBudget } from "../src/budget.ts";
export { isCgs, MEDIA_TYPE } from "../src/sources.ts";

export type CgsMeshOptions = ShownOptions<CgsMesh>;

/**
 * A SplatMesh of a .cgs file: coarse as soon as the first part of the file is there, then finer. Axes are the file's, as
 * with Spark's own files; the origin is at `info.worldOffset`.
 */
export class CgsMesh extends SplatMesh {
  /** Resolves when all of the file is shown; rejects if it is damaged or cannot be had. */
  readonly complete: Promise<this>;
  private readonly live: LiveScene<"spark">;
  private readonly rgba = new RgbaArray();

  constructor(source: Source, options: CgsMeshOptions = {}) {
    super({ extSplats: new ExtSplats() });
    this.isInitialized = false;
    this.live = new LiveScene<"spark">(source, {
      layout: "spark",
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
    this.onFrame = () => this.follow();
  }

  /** Of what is there so far, null before the first scene. */
  get info(): SceneInfo | null {
    return this.live.info;
  }

  /** Whether colors are those of the camera of the last frame. */
  get isSettled(): boolean {
    return this.live.isSettled;
  }

  /** A camera at one of the file's viewpoints, that sees all of its picture; its `up` is the scene's, for controls. */
  camera(view = 0, aspect = 1): PerspectiveCamera {
    return viewpointCamera(this, this.known(), view, aspect);
  }

  /** What controls turn about, from one of the file's viewpoints. */
  target(view = 0): Vector3 {
    return viewpointTarget(this, this.known(), view);
  }

  private known(): SceneInfo {
    if (!this.info) throw new Error("The file's viewpoints are not there yet: await mesh.initialized.");
    return this.info;
  }

  override dispose(): void {
    this.live.dispose();
    this.rgba.dispose();
    super.dispose();
  }

  /** Spark calls it with each frame, after it has found the camera in the mesh's coordinates. */
  private follow(): void {
    this.live.follow(this.context.viewToObject.translate.value.toArray());
  }

  private setSplats({ geometry, colors }: Splats<"spark">): void {
    const count = colors.length / 4;
    const { maxSplats } = utils.getTextureSize(Math.max(1, count));
    const [first, second] = geometry.words.map((words) => {
      const padded = new Uint32Array(4 * maxSplats);
      padded.set(words);
      return padded;
    }) as [Uint32Array, Uint32Array];
    const before = this.extSplats;
    this.extSplats = new ExtSplats({ extArrays: [first, second], numSplats: count });
    this.splats = this.extSplats;
    this.numSplats = count;
    before?.dispose();
    this.rgba.ensureCapacity(Math.max(1, count));
    this.rgba.count = count;
    this.splatRgba = this.rgba;
    this.isInitialized = true;
    this.updateGenerator();
    this.setColors(colors);
  }

  private setColors(colors: Uint8Array): void {
    this.rgba.array!.set(colors);
    this.rgba.needsUpdate = true;
    this.updateVersion();
  }
}

/** Loads .cgs files as loaders of three.js do. A mesh is there with the first part of its file, and becomes finer. */
export class CgsLoader extends Loader<CgsMesh> {
  override load(
    url: string,
    onLoad: (mesh: CgsMesh) => void,
    onProgress?: (event: ProgressEvent) => void,
    onError?: (error: unknown) => void,
  ): CgsMesh {
    const address = this.manager.resolveURL(this.path + url);
    const mesh = new CgsMesh(address, {
      onProgress: (loaded, total) =>
        onProgress?.(
          new ProgressEvent("progress", { lengthComputable: total !== null, loaded, total: total ?? 0 }),
        ),
    });
    this.manager.itemStart(address);
    mesh.initialized.then(
      () => onLoad(mesh),
      (error: unknown) => {
        if (onError) onError(error);
        else console.error(error);
      },
    );
    mesh.complete.catch(() => this.manager.itemError(address)).finally(() => this.manager.itemEnd(address));
    return mesh;
  }
}

/** Makes a manager's `getHandler` find this loader by a file's ending or media type. */
export function registerCgs(manager: LoadingManager): void {
  // A pattern with a test of its own: media types are only in addresses that hold the data.
  manager.addHandler({ test: (address: string) => isCgs(address) } as RegExp, new CgsLoader(manager));
}

/**
 * Lines of Spark's vertex shader, and what stands in their place. Spark takes the Jacobian of the projection at a splat's
 * middle, which far outside of the picture smears a splat across all of it; and the smaller variance of a splat in the
 * picture is a difference of large numbers, without a digit that is right where it is long and thin.
 */
const AS_TRAINED = [
  [
    "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
    `vec2 sides = vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
     vec2 shift = projectionMatrix[2].xy;
     vec2 J2 = J1 * clamp(-viewCenter.xy * invZ, (shift - ${EDGE}) / sides, (shift + ${EDGE}) / sides);`,
  ],
  [
    "float eigen2 = eigenAvg - eigenDelta;",
    "float eigen2 = max(det / eigen1, preBlurAmount + fullBlurAmount);",
  ],
] as const;
/** Halves of the picture beyond which splats are left out: large ones that lie outside reach into it. */
const CLIP = 1e3;
/** The same where the shader is another and nothing is clamped. */
const CLIP_UNCLAMPED = 2;

/**
 * Spark's renderer as .cgs files want it: splats widened as in their training, without a loss of opacity, sorted by
 * depth, those outside of the picture as in training, and not rounded further on their way.
 */
export class CgsSparkRenderer extends SparkRenderer {
  constructor(options: SparkRendererOptions) {
    super({
      accumExtSplats: true,
      sortRadial: false,
      blurAmount: 0,
      preBlurAmount: 0.3,
      maxStdDev: Math.sqrt(-2 * Math.log(CUTOFF)),
      minAlpha: CUTOFF,
      maxPixelRadius: 1e4,
      clipXY: CLIP,
      ...options,
    });
    if (AS_TRAINED.every(([line]) => this.material.vertexShader.includes(line))) {
      for (const [line, better] of AS_TRAINED) {
        this.material.vertexShader = this.material.vertexShader.replace(line, better);
      }
    } else {
      console.warn(
        "compgs: this version of Spark has another shader: splats outside of the picture are left out.",
      );
      this.clipXY = options.clipXY ?? CLIP_UNCLAMPED;
    }
  }

  override onBeforeRender(...[renderer, scene, camera]: Parameters<SparkRenderer["onBeforeRender"]>): void {
    const dilation = dilationIn(renderer, scene, camera as PerspectiveCamera);
    if (dilation !== null) this.preBlurAmount = dilation;
    super.onBeforeRender(renderer, scene, camera);
  }
}

/** What widens the splats of .cgs files in this picture, pixels^2; the least of them where there are several. */
function dilationIn(renderer: WebGLRenderer, scene: Scene, camera: PerspectiveCamera): number | null {
  const { width, height } = renderer.getRenderTarget() ?? renderer.getDrawingBufferSize(new Vector2());
  const [fx, fy] = [
    (width / 2) * camera.projectionMatrix.elements[0]!,
    (height / 2) * camera.projectionMatrix.elements[5]!,
  ];
  let least: number | null = null;
  scene.traverseVisible((node) => {
    if (!(node instanceof CgsMesh) || !node.info) return;
    least = Math.min(least ?? Infinity, dilationOf(node.info.angularDilation, { fx, fy }));
  });
  return least;
}

/**
 * Puts splats into a scene, with the renderer of splats and the background that they want where the scene has none.
 * Gives a camera at the file's first viewpoint.
 */
export function setStage(scene: Scene, renderer: WebGLRenderer, mesh: CgsMesh): PerspectiveCamera {
  if (!scene.children.some((child) => child instanceof SparkRenderer)) {
    scene.add(new CgsSparkRenderer({ renderer }));
  }
  scene.background ??= new Color().setRGB(...(mesh.info?.background ?? [0, 0, 0]), SRGBColorSpace);
  scene.add(mesh);
  const { width, height } = renderer.getDrawingBufferSize(new Vector2());
  return mesh.camera(0, width / height);
}
