/** What a file is that is no .cgs file, in words, and what to do with it. */

interface Kind {
  name: string;
  /** First bytes, as letters. */
  begins: string;
  remedy: string;
}

const COMPRESS = "`compgs compress` makes a .cgs file of it.";
const KINDS: Kind[] = [
  { name: "a .ply", begins: "ply", remedy: COMPRESS },
  { name: "a .spz", begins: "\x1f\x8b", remedy: COMPRESS },
  { name: "a .spz", begins: "NGSP", remedy: COMPRESS },
  { name: "a .glb", begins: "glTF", remedy: COMPRESS },
  { name: "a .sog", begins: "PK\x03\x04", remedy: COMPRESS },
  {
    name: "a JPEG picture",
    begins: "\xff\xd8\xff",
    remedy: "A page shows scenes: `compgs train` makes one of photographs.",
  },
  {
    name: "a PNG picture",
    begins: "\x89PNG",
    remedy: "A page shows scenes: `compgs train` makes one of photographs.",
  },
  {
    name: "a web page",
    begins: "<",
    remedy: "If the address of a file was meant, it leads elsewhere: to a page, or to a login.",
  },
  {
    name: "the list of a scene's tiles",
    begins: '{"format":"compgs tiles"',
    remedy: "Its tiles are fetched from beside it: `compgs serve` shows the folder.",
  },
  { name: "JSON", begins: "{", remedy: "Of a scene in tiles, `compgs serve` shows the folder." },
];

/** Two sentences, or null of a file that is not known. */
export function whatItIs(head: Uint8Array): { title: string; remedy: string } | null {
  if (!head.length) return { title: "This file is empty", remedy: "Copy or download it again." };
  const letters = String.fromCharCode(...head.subarray(0, 32)).trimStart();
  const kind = KINDS.find(({ begins }) => letters.startsWith(begins));
  return kind ? { title: `This is ${kind.name}, not a .cgs file`, remedy: kind.remedy } : null;
}
