/** What a .cgs file is shown with in every engine. */

export interface ShownOptions<Shown> {
  /** Bytes of the file so far and of all, the latter if it is known. */
  onProgress?: (loaded: number, total: number | null) => void;
  /** What is shown has become a scene, or a finer one. */
  onSplats?: (shown: Shown) => void;
  /** Splats that are wanted: finer parts of the file that would be more are not fetched. By default `splatBudget()`. */
  most?: number;
  /** Of `compgs/worker`, for pages whose policy forbids workers from blobs. */
  worker?: Worker;
}
