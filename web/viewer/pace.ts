/** How large a picture may be while somebody moves, so that frames come in time. */

/** Milliseconds between two frames, from which on pictures become smaller, and below which they become larger. */
const SLOW = 40;
const QUICK = 22;
/** Of the sides: less cannot be recognized. */
const LEAST = 0.2;
/** Of the sides, from one frame to the next: a frame that took long for another reason is not followed at once. */
const MOST_SHRINK = 0.3;
const GROWTH = 1.1;

export class Pace {
  /** Of the sides of a full picture. */
  share = 1;

  /** A frame of the present share came so many milliseconds after the one before. */
  took(milliseconds: number): void {
    if (milliseconds > SLOW) {
      // Pixels cost the time, mostly; half way, as some of it does not depend on them.
      const wanted = Math.sqrt((SLOW + QUICK) / 2 / milliseconds);
      this.share = Math.max(LEAST, this.share * Math.max(MOST_SHRINK, wanted));
    } else if (milliseconds < QUICK) this.share = Math.min(1, this.share * GROWTH);
  }
}
