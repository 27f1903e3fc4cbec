/** Where the bytes of a file come from, and how a .cgs file is known before they are there. */

/** IANA's form for a file format of one vendor; servers may send it, and none must. */
export const MEDIA_TYPE = "model/vnd.compgs";
/** In addresses, with what may follow: `?` and `#`. */
const ENDING = /\.cgs(?:[?#]|$)/i;

/** Bytes that arrive piece by piece. */
export type ByteStream = ReadableStream<Uint8Array> | Response | Blob;
/** An address, or the bytes. */
export type Source = string | URL | ArrayBuffer | Uint8Array | ByteStream;

/** Whether a file's name or address, or its media type if one is known, says that it is a .cgs file. */
export function isCgs(name: string, mediaType?: string | null): boolean {
  const named = mediaType?.split(";")[0]!.trim().toLowerCase();
  return named === MEDIA_TYPE || ENDING.test(name) || name.toLowerCase().startsWith(`data:${MEDIA_TYPE}`);
}

export async function* piecesOf(stream: ByteStream): AsyncGenerator<Uint8Array> {
  const reader = streamOf(stream).getReader();
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      yield value;
    }
  } finally {
    // Of a stream that ended this does nothing; one whose bytes are damaged is not fetched further.
    void reader.cancel().catch(() => {});
  }
}

function streamOf(stream: ByteStream): ReadableStream<Uint8Array> {
  if (stream instanceof Blob) return stream.stream();
  if (!(stream instanceof Response)) return stream;
  if (!stream.ok)
    throw new Error(`${stream.url}: the server answers ${stream.status} ${stream.statusText}`.trim());
  return stream.body ?? new Blob([]).stream();
}
