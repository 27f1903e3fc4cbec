/** What the viewer decides by itself: where a scene is opened from, what a click meets, how large pictures are. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { build } from "esbuild";

const exported = ["first_view", "kinds", "pace", "pick", "pose"].map(
  (name) => `export * from "./viewer/${name}.ts";`,
);
const { outputFiles } = await build({
  stdin: { contents: exported.join("\n"), resolveDir: new URL("..", import.meta.url).pathname, loader: "ts" },
  bundle: true,
  format: "esm",
  write: false,
});
const { Pace, Pose, distanceAlong, firstView, whatItIs } = await import(
  `data:text/javascript;base64,${Buffer.from(outputFiles[0].text).toString("base64")}`
);

/** A viewpoint that looks from one place to another. */
function looking(from, to) {
  const { right, down, forward } = Pose.lookingAt(from, to, [0, -1, 0]);
  const m = [...right, ...down, ...forward];
  // Shepperd's method, largest component first.
  const trace = m[0] + m[4] + m[8];
  const squares = [trace, m[0] - m[4] - m[8], m[4] - m[0] - m[8], m[8] - m[0] - m[4]];
  const i = squares.indexOf(Math.max(...squares));
  const rows = [
    [1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]],
    [m[7] - m[5], 1 + squares[1], m[1] + m[3], m[2] + m[6]],
    [m[2] - m[6], m[1] + m[3], 1 + squares[2], m[5] + m[7]],
    [m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 + squares[3]],
  ];
  const length = Math.hypot(...rows[i]);
  return { position: from, rotation: rows[i].map((x) => x / length), width: 100, height: 80, fx: 90, fy: 90 };
}

const circle = (count, radius) =>
  Array.from({ length: count }, (_, i) => {
    const angle = (2 * Math.PI * i) / count;
    return [radius * Math.cos(angle), 0, radius * Math.sin(angle)];
  });
const ball = circle(60, 1).flatMap(([x, , z], i) => [x, ((i % 7) - 3) / 3, z]);

test("a scene is opened from the viewpoint that has most of it in its picture", () => {
  const views = [
    looking([0, 0, -1.2], [0, 0, 0]), // a close-up
    looking([0, 0, -4], [0, 0, 0]),
    looking([0, 0, -4], [5, 0, -4]), // past it
  ];
  assert.deepEqual(firstView(ball, { up: [0, -1, 0], views }, 1), { view: 1, isInside: false });
  assert.deepEqual(firstView(ball, null, 1), { view: 0, isInside: false });
});

test("of viewpoints that show as much, the one that looks as most do comes first", () => {
  const front = [-0.3, 0, 0.3].map((x) => looking([x, 0, -4], [0, 0, 0]));
  const aside = [-5, 5].map((x) => looking([x, 0, 0], [0, 0, 0]));
  const views = [aside[0], ...front, looking([0, 0, -0.5], [0, 0, 0]), aside[1]];
  assert.equal(firstView(ball, { up: [0, -1, 0], views }, 1).view, 2);
});

test("one looks around where the cameras did, and turns about what they surrounded", () => {
  const of = (views) => firstView(ball, { up: [0, -1, 0], views }, 1).isInside;
  assert.equal(of(circle(8, 4).map((place) => looking(place, [0, 0, 0]))), false);
  const outwards = circle(8, 0.5).map(([x, y, z]) => looking([x, y, z], [9 * x, y, 9 * z]));
  assert.equal(of(outwards), true);
  assert.equal(
    of(circle(8, 0.1).map(([x, y, z]) => looking([x, y, z], [-9 * x, y, -9 * z]))),
    true,
    "in one place",
  );
  const far = ball.map((x) => 30 * x); // what stands behind something that was walked around
  const around = circle(8, 4).map((place) => looking(place, [0, 0, 0]));
  const inFront = [...ball.slice(0, 6), ...far, ...far];
  assert.equal(
    firstView(inFront, { up: [0, -1, 0], views: around }, 30).isInside,
    false,
    "before a far background",
  );
  const forward = circle(8, 1).map(([x, , z]) => looking([x, z, 0], [x, z, 9]));
  assert.equal(of(forward), false, "all look the same way");
});

/** Flat splats that face z, across everything, at depths with opacities. */
function walls(given) {
  return [
    {
      means: given.flatMap(([z]) => [0.1, -0.1, z]),
      quaternions: given.flatMap(() => [2, 0, 0, 0]),
      scales: given.flatMap(() => [5, 5, 1e-4]),
      sound: given.map(() => 1),
    },
    given.map(([, opacity]) => opacity),
  ];
}

test("a click meets what hides half of the light", () => {
  const meet = (given) => distanceAlong([0, 0, 0], [0, 0, 1], 1e-3, ...walls(given), 0.01);
  assert.equal(
    meet([
      [9, 0.9],
      [4, 0.9],
    ]),
    4,
  );
  assert.equal(
    meet([
      [4, 0.25],
      [6, 0.25],
      [8, 0.25],
    ]),
    8,
    "0.75^3 is the first below a half",
  );
  assert.equal(meet([[4, 0.1]]), null);
  assert.equal(meet([[-4, 0.9]]), null, "behind the camera");
  assert.equal(
    meet([
      [4, NaN],
      [7, 0.9],
    ]),
    7,
  );
});

test("a click passes by a splat that it does not meet, however it is turned", () => {
  const half = Math.SQRT1_2;
  // Long in its own x, which is turned into y.
  const splat = { means: [1, 0, 5], quaternions: [half, 0, 0, half], scales: [3, 0.1, 0.1], sound: [1] };
  const meet = (direction) => {
    const length = Math.hypot(...direction);
    return distanceAlong(
      [0, 0, 0],
      direction.map((x) => x / length),
      1e-4,
      splat,
      [0.95],
      0.01,
    );
  };
  assert.ok(Math.abs(meet([1, 2, 5]) - 26 / Math.sqrt(30)) < 1e-6);
  assert.equal(meet([2, 0, 5]), null);
});

test("pictures shrink while frames are late, grow while there is time, and never beyond recognition", () => {
  const pace = new Pace();
  pace.took(30);
  assert.equal(pace.share, 1);
  pace.took(160);
  assert.ok(pace.share > 0.3 && pace.share < 0.6);
  for (let i = 0; i < 20; i++) pace.took(5000);
  assert.ok(pace.share >= 0.2);
  const before = pace.share;
  pace.took(10);
  assert.ok(pace.share > before);
  for (let i = 0; i < 40; i++) pace.took(10);
  assert.equal(pace.share, 1);
});

test("files of other kinds are called by their names", () => {
  const bytes = (text) => Uint8Array.from(text, (letter) => letter.charCodeAt(0));
  assert.equal(whatItIs(bytes("ply\nformat ascii 1.0")).title, "This is a .ply, not a .cgs file");
  assert.match(whatItIs(bytes("ply\nformat ascii 1.0")).remedy, /`compgs compress` makes a \.cgs file of it/);
  assert.match(whatItIs(bytes("\n<!doctype html>")).title, /a web page/);
  assert.equal(whatItIs(bytes("")).title, "This file is empty");
  assert.equal(whatItIs(bytes("\x00\x01\x02\x03")), null);
});
