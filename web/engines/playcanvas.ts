/** .cgs files in the PlayCanvas engine: a resource of the component `gsplat`, and colors that follow the camera. */

import {
  type AppBase,
  type Asset,
  BoundingBox,
  type CameraComponent,
  Color,
  Entity,
  type GSplatComponent,
  GSplatContainer,
  GSplatFormat,
  type GraphicsDevice,
  Mat4,
  PIXELFORMAT_RGBA16F,
  PIXELFORMAT_RGBA32F,
  PIXELFORMAT_RGBA8,
  Quat,
  type ResourceHandler,
  Vec3,
  WORKBUFFER_UPDATE_ONCE,
} from "playcanvas";
import { LiveScene, type Splats } from "../src/live/live_scene.ts";
import type { SceneInfo } from "../src/scene_info.ts";
import { type Source, isCgs } from "../src/sources.ts";
import { NEAR, dilationOf } from "../viewer/splatting.ts";
import type { ShownOptions } from "./options.ts";
import { drawAsTrained, setDilation } from "./playcanvas_splatting.ts";
import { startCamera } from "./viewpoint.ts";

export { drawAsTrained } from "./playcanvas_splatting.ts";
export { splatBudget } from "../src/budget.ts";
export { isCgs, MEDIA_TYPE } from "../src/sources.ts";

/** Times the extent of the scene, from the camera: beyond it nothing is drawn. */
const FAR = 1_000;

const READ_GLSL = /* glsl */ `
vec3 getCenter() { return loadMean().xyz; }
vec4 getColor() { return loadTint(); }
vec3 getScale() { return exp(loadLogScale().xyz); }
vec4 getRotation() { return loadTurn(); }
`;
const READ_WGSL = /* wgsl */ `
fn getCenter() -> vec3f { return loadMean().xyz; }
fn getColor() -> vec4f { return loadTint(); }
fn getScale() -> vec3f { return exp(vec3f(loadLogScale().xyz)); }
fn getRotation() -> vec4f { return loadTurn(); }
`;

function splatFormat(device: GraphicsDevice): GSplatFormat {
  return new GSplatFormat(
    device,
    [
      { name: "mean", format: PIXELFORMAT_RGBA32F },
      { name: "logScale", format: PIXELFORMAT_RGBA16F },
      { name: "turn", format: PIXELFORMAT_RGBA16F },
      { name: "tint", format: PIXELFORMAT_RGBA8 },
    ],
    { readGLSL: READ_GLSL, readWGSL: READ_WGSL },
  );
}

export type CgsOptions = ShownOptions<CgsResource>;

/**
 * Splats of a .cgs file: a resource of the component `gsplat`. Axes are the file's, as with the engine's own files; the
 * origin is at `info.worldOffset`. Where several entities show it, colors are those of the first.
 */
export class CgsResource extends GSplatContainer {
  /** Resolves when all of the file is shown; rejects if it is damaged or cannot be had. */
  readonly complete: Promise<this>;
  private camera: CameraComponent | null = null;
  private shownBy: GSplatComponent | null = null;

  private constructor(
    private readonly app: AppBase,
    private readonly live: LiveScene<"playcanvas">,
    /** Of what is there so far. */
    public info: SceneInfo,
  ) {
    super(app.graphicsDevice, Math.max(1, info.totalCoupled), splatFormat(app.graphicsDevice));
    this.complete = live.complete.then(() => this);
    // Who does not wait for it must not answer for it.
    this.complete.catch(() => {});
    app.on("update", this.follow, this);
  }

  /** Resolves with the first part of the file; the resource becomes finer on its own. */
  static async open(app: AppBase, source: Source, options: CgsOptions = {}): Promise<CgsResource> {
    let resource: CgsResource | null = null;
    const live: LiveScene<"playcanvas"> = new LiveScene(source, {
      layout: "playcanvas",
      onSplats: (splats) => {
        resource ??= new CgsResource(app, live, splats.info);
        resource.setSplats(splats);
        options.onSplats?.(resource);
      },
      onColors: (colors) => resource!.setColors(colors),
      ...(options.onProgress && { onProgress: options.onProgress }),
      ...(options.most !== undefined && { most: options.most }),
      ...(options.worker && { worker: options.worker }),
    });
    await live.first;
    return resource!;
  }

  /** Whether colors are those of the camera of the last frame. */
  get isSettled(): boolean {
    return this.live.isSettled;
  }

  override destroy(): void {
    this.app.off("update", this.follow, this);
    this.live.dispose();
    super.destroy();
  }

  private setSplats({ info, geometry, colors }: Splats<"playcanvas">): void {
    this.info = info;
    this.write("mean", geometry.means);
    this.write("logScale", geometry.logScales);
    this.write("turn", geometry.quaternions);
    this.centers = geometry.centers;
    const [least, most] = [new Vec3(geometry.least), new Vec3(geometry.most)];
    this.aabb = new BoundingBox();
    this.aabb.setMinMax(least, most);
    this.update(colors.length / 4);
    this.setColors(colors);
  }

  private setColors(colors: Uint8Array): void {
    this.write("tint", colors);
    for (const component of this.components()) component.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
    this.app.renderNextFrame = true;
  }

  private write(stream: string, values: Float32Array | Uint16Array | Uint8Array): void {
    const texture = this.getTexture(stream)!;
    (texture.lock() as typeof values).set(values);
    texture.unlock();
  }

  private components(): GSplatComponent[] {
    const all = this.app.root.findComponents("gsplat") as GSplatComponent[];
    return all.filter((component) => component.resource === this);
  }

  /** With each frame: says where the first enabled camera is in the coordinates of the splats. */
  private follow(): void {
    if (!isThere(this.camera)) {
      const cameras = this.app.root.findComponents("camera") as CameraComponent[];
      this.camera = cameras.find(isThere) ?? null;
    }
    if (!isThere(this.shownBy) || this.shownBy.resource !== this) this.shownBy = this.components()[0] ?? null;
    if (!this.camera || !this.shownBy) return;
    const { canvas } = this.app.graphicsDevice;
    const { data } = this.camera.projectionMatrix;
    const lens = { fx: (canvas.width / 2) * data[0]!, fy: (canvas.height / 2) * data[5]! };
    setDilation(this.app, dilationOf(this.info.angularDilation, lens));
    const toLocal = new Mat4().copy(this.shownBy.entity.getWorldTransform()).invert();
    const centre = toLocal.transformPoint(this.camera.entity.getPosition());
    this.live.follow([centre.x, centre.y, centre.z]);
  }
}

function isThere<C extends CameraComponent | GSplatComponent>(component: C | null): component is C {
  return component !== null && component.enabled && component.entity?.enabled === true;
}

interface ParserContext {
  url: string | null;
  asset?: Asset;
}

/** Parser of .cgs files for the engine's handler of splats. */
export class CgsParser {
  declare handler?: ResourceHandler;

  constructor(private readonly app: AppBase) {}

  canParse({ url, asset }: ParserContext): boolean {
    return isCgs(url ?? "", mediaTypeOf(contentsOf(asset)));
  }

  load(
    url: string | { load: string },
    callback: (error: string | null, resource?: CgsResource) => void,
    asset?: Asset,
  ): void {
    const address = typeof url === "string" ? url : url.load;
    const onProgress = (loaded: number, total: number | null): void => {
      asset?.fire("progress", loaded, total ?? 0);
    };
    Promise.resolve(contentsOf(asset) ?? address)
      .then((source) => CgsResource.open(this.app, source, { onProgress }))
      .then(
        (resource) => callback(null, resource),
        (error: Error) => callback(`${address}: ${error.message}`),
      );
  }
}

type Contents = Response | ArrayBuffer | Blob;

/** Bytes that an asset brings along. */
function contentsOf(asset: Asset | undefined): Contents | Promise<Contents> | null {
  return (asset?.file as { contents?: Contents | Promise<Contents> } | null)?.contents ?? null;
}

function mediaTypeOf(contents: Contents | Promise<Contents> | null): string | null {
  if (contents instanceof Response) return contents.headers.get("Content-Type");
  return contents instanceof Blob ? contents.type : null;
}

/** Makes assets of type `gsplat` load .cgs files, known by their ending or media type. */
export function registerCgs(app: AppBase): void {
  const handler = app.loader.getHandler("gsplat") as ResourceHandler | undefined;
  if (!handler)
    throw new Error("The application has no handler of splats: add GSplatHandler to its options.");
  if (!handler.parsers.some((parser) => parser instanceof CgsParser)) handler.addParser(new CgsParser(app));
}

/** An entity that shows a .cgs file, in coarse parts at first. It is not in the scene yet. */
export async function loadSplats(app: AppBase, source: Source, options: CgsOptions = {}): Promise<Entity> {
  const resource = await CgsResource.open(app, source, options);
  const entity = new Entity("splats");
  entity.addComponent("gsplat", { resource });
  return entity;
}

/**
 * Puts splats into an application, upright as their file says and drawn as in training, and a camera at the file's first
 * viewpoint with the file's background where there is none. Gives the camera.
 */
export function setStage(app: AppBase, splats: Entity): Entity {
  drawAsTrained(app);
  app.root.addChild(splats);
  const { info } = resourceOf(splats);
  const up = new Vec3(startCamera(info, 0, 1).sceneUp);
  splats.setLocalRotation(new Quat().setFromDirections(up, Vec3.UP));
  const there = (app.root.findComponents("camera") as CameraComponent[]).find(isThere)?.entity as Entity;
  if (there) return there;
  const camera = new Entity("camera");
  const [red, green, blue] = info.background;
  camera.addComponent("camera", { clearColor: new Color(red, green, blue) });
  app.root.addChild(camera);
  goTo(camera, splats);
  return camera;
}

/** Moves a camera to one of the file's viewpoints, so that it sees all of its picture. */
export function goTo(camera: Entity, splats: Entity, view = 0): void {
  const { info } = resourceOf(splats);
  const { canvas } = camera.camera!.system.app.graphicsDevice;
  const aspect = canvas.width / canvas.height;
  const { right, up, back, centre, fieldOfView } = startCamera(info, view, aspect);
  // prettier-ignore
  const pose = new Mat4().set([
    ...right, 0,
    ...up, 0,
    ...back, 0,
    ...centre, 1,
  ]);
  pose.mul2(splats.getWorldTransform(), pose);
  camera.setPosition(pose.getTranslation());
  camera.setEulerAngles(pose.getEulerAngles());
  camera.camera!.fov = (fieldOfView * 180) / Math.PI;
  camera.camera!.nearClip = NEAR;
  camera.camera!.farClip = FAR * info.extent + Math.hypot(...centre);
}

function resourceOf(splats: Entity): CgsResource {
  const resource = splats.gsplat?.resource;
  if (!(resource instanceof CgsResource)) throw new Error(`${splats.name}: shows no .cgs file`);
  return resource;
}
