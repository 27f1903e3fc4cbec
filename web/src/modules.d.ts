/** Files that the build embeds as bytes. */
declare module "*.bin" {
  const bytes: Uint8Array;
  export default bytes;
}
declare module "*.wasm" {
  const bytes: Uint8Array;
  export default bytes;
}
/** The worker's program, bundled by the build. */
declare module "compgs:worker" {
  const source: string;
  export default source;
}
