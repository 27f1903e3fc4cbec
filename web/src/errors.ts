/**
 * What can be wrong with a file, by the names of the Python package.
 *
 * Messages name the place, what was expected and what was found.
 */

/** Root of everything that decoding raises on purpose. */
export class BitstreamError extends Error {
  override name = "BitstreamError";
}

/** The first bytes are not those of a .cgs file. */
export class NotACompGSFile extends BitstreamError {
  override name = "NotACompGSFile";
}

/** The file's version, or a section that it needs, is not one that this decoder knows. */
export class UnsupportedVersion extends BitstreamError {
  override name = "UnsupportedVersion";
}

/** The file ends before a section does. */
export class TruncatedSection extends BitstreamError {
  override name = "TruncatedSection";
}

/** A section contradicts its checksum, the format's limits, or another section. */
export class CorruptSection extends BitstreamError {
  override name = "CorruptSection";
}

/** The file is sound, but decoding it needs something that a browser does not have. */
export class MissingDependency extends BitstreamError {
  override name = "MissingDependency";
}
