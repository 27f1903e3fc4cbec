/** JSON in the one form of which the checksum of a manifest is: without spaces, names in order, numbers as written. */

const TOKEN = /\s*("(?:[^"\\\u0000-\u001f]|\\.)*"|-?\d[\d.eE+-]*|true|false|null|[[\]{}:,])/y;
/** Lists and objects within each other; manifests have five. */
const MOST_DEPTH = 32;

/** The text of an object without some of its names, in canonical form. Throws SyntaxError for what is no JSON object. */
export function canonicalJson(text: string, without: readonly string[] = []): string {
  const tokens = new Tokens(text);
  tokens.expect("{");
  const canonical = objectOf(tokens, 1, without);
  tokens.end();
  return canonical;
}

class Tokens {
  private at = 0;

  constructor(private readonly text: string) {}

  next(): string {
    TOKEN.lastIndex = this.at;
    const found = TOKEN.exec(this.text);
    if (!found) throw new SyntaxError(`no JSON at character ${this.at}`);
    this.at = TOKEN.lastIndex;
    return found[1]!;
  }

  expect(token: string): void {
    const found = this.next();
    if (found !== token)
      throw new SyntaxError(`expected ${token}, found ${found} before character ${this.at}`);
  }

  end(): void {
    if (this.text.slice(this.at).trim())
      throw new SyntaxError(`more than one value, from character ${this.at}`);
  }
}

function valueOf(tokens: Tokens, token: string, depth: number): string {
  if (depth > MOST_DEPTH) throw new SyntaxError("too many lists within each other");
  if (token === "{") return objectOf(tokens, depth + 1, []);
  if (token !== "[") return token.startsWith('"') ? asciiString(token) : scalar(token);
  const parts: string[] = [];
  for (let next = tokens.next(); next !== "]"; next = tokens.next()) {
    if (parts.length) next = next === "," ? tokens.next() : refuse(next);
    parts.push(valueOf(tokens, next, depth + 1));
  }
  return `[${parts.join(",")}]`;
}

function objectOf(tokens: Tokens, depth: number, without: readonly string[]): string {
  const entries: Array<[string, string]> = [];
  for (let next = tokens.next(); next !== "}"; next = tokens.next()) {
    if (entries.length) next = next === "," ? tokens.next() : refuse(next);
    const name = next.startsWith('"') ? (JSON.parse(next) as string) : refuse(next);
    tokens.expect(":");
    entries.push([name, valueOf(tokens, tokens.next(), depth)]);
  }
  // Names of manifests are ASCII, of which the order of UTF-16 is that of code points.
  entries.sort(([a], [b]) => (a < b ? -1 : Number(a > b)));
  const parts = entries.filter(([name]) => !without.includes(name));
  return `{${parts.map(([name, value]) => `${asciiString(JSON.stringify(name))}:${value}`).join(",")}}`;
}

function scalar(token: string): string {
  if (["]", "}", ":", ","].includes(token)) return refuse(token);
  JSON.parse(token);
  return token;
}

function asciiString(token: string): string {
  const text = JSON.stringify(JSON.parse(token));
  return text.replace(/[\u007f-\uffff]/g, (unit) => `\\u${unit.charCodeAt(0).toString(16).padStart(4, "0")}`);
}

function refuse(token: string): never {
  throw new SyntaxError(`${token} is out of place`);
}
