/** The Gaussian tables, embedded by the build from the Python package's own file. */

import tables from "../../../src/compgs/codec/gaussian_tables.bin";

export function gaussianTableBytes(): Uint8Array {
  return tables;
}
