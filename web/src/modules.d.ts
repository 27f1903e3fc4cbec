/** Files that the build embeds as bytes. */
declare module "*.bin" {
  const bytes: Uint8Array;
  export default bytes;
}
/** assembly/, compiled by the build. */
declare module "compgs:kernels" {
  const bytes: Uint8Array<ArrayBuffer>;
  export default bytes;
}
/** The worker's program, bundled by the build. */
declare module "compgs:worker" {
  const source: string;
  export default source;
}
/** The program of a live scene's worker, bundled by the build. */
declare module "compgs:live-worker" {
  const source: string;
  export default source;
}
/** The program that sorts splats in plain three.js, bundled by the build. */
declare module "compgs:sorter" {
  const source: string;
  export default source;
}
