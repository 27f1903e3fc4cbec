/**
 * Where directions are clamped for the Jacobian of the projection, in halves of the picture from its middle. Engines take
 * it at a splat's middle wherever that is: far outside of the picture it smears a large splat across all of it.
 */

import { MARGIN } from "../viewer/splatting.ts";

export const EDGE = 1 + 2 * MARGIN;
