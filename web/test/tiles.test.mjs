/** Scenes of tiles: what a camera needs is fetched, the coarsest first, and no byte twice. */

import assert from "node:assert/strict";
import { existsSync, readFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { test } from "node:test";
import { FIXTURES, compgs, hashesOf } from "./fixtures.mjs";

const { TileLoader, decode, planDetail, readManifest, sizeOf } = compgs;
const CITY = join(FIXTURES, "city.tiles");
const skip = !FIXTURES || !existsSync(CITY);
const text = skip ? "" : readFileSync(join(CITY, "manifest.json"), "utf8");
const manifest = skip ? null : readManifest(text);

/** Straight down is y. Looks from above a place along a direction of the ground, a little down. */
function sight(x, z, towards = [0, 1], height = 3) {
  const [u, v] = towards;
  const slope = 1 / Math.SQRT2;
  const rotation = [v, 0, -u, -u * slope, slope, -v * slope, u * slope, slope, v * slope];
  return { centre: [x, -height, z], rotation, width: 1280, height: 800, fx: 1000, fy: 1000 };
}

/** Where tile i_j is, of the manifest's frame. */
function placeOf(name) {
  const { worldOffset } = manifest.tiles.find((tile) => tile.name === name);
  return [worldOffset[0] - manifest.worldOffset[0], worldOffset[2] - manifest.worldOffset[2]];
}

/** Serves the city; `asked` has the bytes of each request, by file. */
async function serve({ ranges = true, damaged = null, delay = 0 } = {}) {
  const asked = [];
  const server = createServer((request, response) => {
    const name = request.url.slice(1);
    const bytes = Buffer.from(readFileSync(join(CITY, name)));
    if (name === damaged) bytes[bytes.length >> 1] ^= 1;
    const wanted = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? "");
    const [first, last] = wanted && ranges ? [Number(wanted[1]), Number(wanted[2])] : [0, bytes.length - 1];
    asked.push({ name, first, last });
    const isPart = wanted && ranges;
    const headers = isPart ? { "Content-Range": `bytes ${first}-${last}/${bytes.length}` } : {};
    setTimeout(() => {
      response.writeHead(isPart ? 206 : 200, headers);
      response.end(bytes.subarray(first, last + 1));
    }, delay);
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const close = () => {
    server.closeAllConnections();
    server.close();
  };
  return { asked, base: `http://127.0.0.1:${server.address().port}/manifest.json`, close };
}

/** A loader, what it shows, and a way to look and wait. */
function open(base, options = {}) {
  const scenes = new Map();
  const shown = [];
  const errors = [];
  let resolve = null;
  const loader = new TileLoader(manifest, base, {
    most: Infinity,
    onTile(tile, scene, shift, levels) {
      if (scene) scenes.set(tile, { scene, shift, levels });
      else scenes.delete(tile);
      shown.push(loader.splats);
    },
    onSharp: () => resolve?.(),
    onError: (error) => errors.push(error),
    ...options,
  });
  const look = (from) =>
    new Promise((done) => {
      resolve = done;
      loader.look(from);
    });
  return { loader, scenes, shown, errors, look };
}

function checkNothingTwice(asked) {
  const byFile = Map.groupBy ? Map.groupBy(asked, ({ name }) => name) : new Map();
  for (const each of Map.groupBy ? [] : asked)
    byFile.set(each.name, [...(byFile.get(each.name) ?? []), each]);
  for (const parts of byFile.values()) {
    let end = 0;
    for (const { first, last } of parts.sort((a, b) => a.first - b.first)) {
      assert.equal(first, end, "each request goes on where the one before ended");
      end = last + 1;
    }
  }
}

const bytesOf = (asked) => asked.reduce((sum, { first, last }) => sum + last + 1 - first, 0);
const wholeOf = ({ levels }) => levels.at(-1);
const allBytes = () => manifest.tiles.reduce((sum, tile) => sum + wholeOf(tile).bytes, 0);

test("a manifest is read as Python writes it, and refused where anything in it was changed", { skip }, () => {
  assert.equal(manifest.tiles.length, 25);
  const first = manifest.tiles[0];
  const file = readFileSync(join(CITY, first.file));
  const { ranges } = decode(file);
  assert.equal(first.levels.length, ranges.length);
  assert.equal(wholeOf(first).bytes, file.length);
  const digits = [...text.matchAll(/\d/g)].map(({ index }) => index).filter((index) => index > 40);
  for (let i = 0; i < digits.length; i += Math.ceil(digits.length / 50)) {
    const at = digits[i];
    const changed = text.slice(0, at) + (text[at] === "7" ? "3" : "7") + text.slice(at + 1);
    assert.throws(() => readManifest(changed), /CorruptSection|UnsupportedVersion/, `at ${at}`);
  }
  const spaced = text.replaceAll(",", ", ").replace('"up"', '\n  "up"');
  assert.deepEqual(readManifest(spaced), manifest);
  assert.throws(() => readManifest(text.slice(0, -9)), { name: "CorruptSection" });
  assert.throws(() => readManifest("{}"), { name: "NotACompGSFile" });
});

const sizes = () => manifest.tiles.map(sizeOf);
const nothing = () => new Int32Array(manifest.tiles.length);

test("of tiles alike, the nearest in view comes first, and the farther the fewer levels", { skip }, () => {
  const [x, z] = placeOf("2_0");
  const { steps, levels } = planDetail(manifest.tiles, sizes(), sight(x, z), Infinity, nothing());
  const names = steps.map(({ tile }) => manifest.tiles[tile].name);
  assert.equal(names[0], "2_0");
  const along = ["2_0", "2_1", "2_2", "2_3", "2_4"].map((name) => names.indexOf(name));
  assert.deepEqual(
    along,
    along.toSorted((a, b) => a - b),
  );
  const wanted = (name) => levels[manifest.tiles.findIndex((tile) => tile.name === name)];
  assert.ok(wanted("2_0") >= wanted("2_4"));
  for (let i = 1; i < steps.length; i++) assert.ok(steps[i].coarseness <= steps[i - 1].coarseness);
});

test("tiles have the levels that the package draws", { skip }, () => {
  const cases = JSON.parse(readFileSync(join(CITY, "wanted.json"), "utf8"));
  for (const { sight, most, levels } of cases)
    assert.deepEqual([...planDetail(manifest.tiles, sizes(), sight, most, nothing()).levels], levels);
  assert.ok(new Set(cases.map(({ levels }) => levels.join())).size > 5);
});

test("what is behind the camera comes after what is as near before it", { skip }, () => {
  const [x, z] = placeOf("2_2");
  const look = (towards) => {
    const { steps } = planDetail(manifest.tiles, sizes(), sight(x, z, towards), Infinity, nothing());
    return steps.findIndex(({ tile }) => manifest.tiles[tile].name === "2_4");
  };
  assert.ok(look([0, 1]) < look([0, -1]) || look([0, -1]) === -1);
});

test("with a cap the nearest tiles have their levels, and what is there gives way to them", { skip }, () => {
  const one = wholeOf(manifest.tiles[0]).coupled;
  const kept = Int32Array.from(manifest.tiles, ({ levels }) => levels.length);
  for (const most of [one, 3 * one, 10 * one]) {
    for (const there of [nothing(), kept]) {
      const [x, z] = placeOf("0_0");
      const { levels } = planDetail(manifest.tiles, sizes(), sight(x, z), most, there);
      const splats = manifest.tiles.reduce(
        (sum, tile, i) => sum + (levels[i] ? tile.levels[levels[i] - 1].coupled : 0),
        0,
      );
      assert.ok(splats <= most && splats > 0.6 * most, `${splats} of ${most}`);
      assert.ok(levels[0] > 0);
    }
  }
  const { levels } = planDetail(manifest.tiles, sizes(), sight(1e6, 1e6), Infinity, kept);
  assert.deepEqual(levels, kept, "with room for everything nothing is dropped");
});

test("a walk through the city and back asks for no byte twice, and for less than all", { skip }, async () => {
  const { asked, base, close } = await serve();
  const most = 3 * wholeOf(manifest.tiles[0]).coupled;
  const { loader, scenes, shown, errors, look } = open(base, { most });
  const stops = ["0_0", "0_1", "1_1", "0_1", "0_0"];
  let there = 0;
  for (const [i, name] of stops.entries()) {
    await look(sight(...placeOf(name)));
    assert.ok(loader.isSharp && loader.missing === 0);
    if (i === 2) there = asked.length;
  }
  assert.equal(asked.length, there, "on the way back everything is there");
  checkNothingTwice(asked);
  assert.equal(bytesOf(asked), loader.loaded);
  assert.ok(loader.loaded < 0.8 * allBytes(), `${loader.loaded} of ${allBytes()}`);
  assert.ok(Math.max(...shown) <= most);
  assert.deepEqual(errors, []);
  for (const [tile, { scene, shift, levels }] of scenes) {
    const { file, levels: all, worldOffset } = manifest.tiles[tile];
    const prefix = readFileSync(join(CITY, file)).subarray(0, all[levels - 1].bytes);
    assert.deepEqual(hashesOf(scene), hashesOf(decode(prefix, { prefix: true })));
    assert.deepEqual(
      shift,
      worldOffset.map((x, axis) => x - manifest.worldOffset[axis]),
    );
  }
  close();
});

test("a camera that moves while bytes arrive asks for none twice", { skip }, async () => {
  const { asked, base, close } = await serve({ delay: 5 });
  const { loader, look } = open(base, { most: 6 * wholeOf(manifest.tiles[0]).coupled });
  for (let i = 0; i < 12; i++) {
    loader.look(sight(...placeOf(`${i % 5}_${(2 * i) % 5}`)));
    await new Promise((resolve) => setTimeout(resolve, 7));
  }
  await look(sight(...placeOf("4_0")));
  checkNothingTwice(asked);
  assert.ok(loader.isSharp);
  close();
});

test("every tile in view is there before any of them is whole", { skip }, async () => {
  const { asked, base, close } = await serve();
  const { look } = open(base);
  const [[x, z], [, next]] = [placeOf("2_0"), placeOf("2_1")];
  await look(sight(x, z - 5 * (next - z), [0, 1], 7 * (next - z)));
  assert.equal(asked.filter(({ first }) => first === 0).length, 25);
  const last = asked.findLastIndex(({ first }) => first === 0);
  const whole = asked.findIndex(({ last }) => last + 1 === wholeOf(manifest.tiles[0]).bytes);
  assert.ok(whole > last, `the first whole tile is request ${whole}, the last new one ${last}`);
  close();
});

test("where the server knows no ranges, each file is fetched once and whole", { skip }, async () => {
  const { asked, base, close } = await serve({ ranges: false });
  const { scenes, loader, look } = open(base);
  await look(sight(...placeOf("0_0")));
  await look(sight(...placeOf("1_0")));
  assert.equal(new Set(asked.map(({ name }) => name)).size, asked.length);
  assert.ok(scenes.size && loader.isSharp);
  close();
});

test("a damaged tile is named once, and the others are shown", { skip }, async () => {
  const { base, close } = await serve({ damaged: "0_1.cgs" });
  const { scenes, errors, look, loader } = open(base);
  await look(sight(...placeOf("0_0"), [0, 1], 1));
  assert.equal(errors.length, 1);
  assert.match(errors[0].message, /^0_1\.cgs: /);
  assert.ok(scenes.size > 2 && loader.isSharp);
  close();
});

test("a tile of another scene is refused, although its sections are whole", { skip }, async () => {
  const { base, close } = await serve();
  const name = manifest.tiles[0].name;
  const other = structuredClone(manifest);
  other.tiles[0].worldOffset[1] += 1;
  const errors = [];
  await new Promise((resolve) => {
    const loader = new TileLoader(other, base, {
      most: Infinity,
      onTile() {},
      onSharp: resolve,
      onError: (error) => errors.push(error),
    });
    loader.look(sight(...placeOf(name)));
  });
  assert.deepEqual(
    errors.map(({ message }) => message),
    [`${name}.cgs: holds another scene than the manifest says`],
  );
  close();
});
