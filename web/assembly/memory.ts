/** Memory as a stack: what is allocated behind a mark goes with it. Nothing is zero at first. */

let top: usize = __heap_base;

export function alloc(bytes: usize): usize {
  const at = (top + 15) & ~15;
  top = at + bytes;
  const pages = <i32>((top + 0xffff) >> 16);
  const missing = pages - memory.size();
  if (missing > 0 && memory.grow(missing) < 0) unreachable();
  return at;
}

export function zeroed(bytes: usize): usize {
  const at = alloc(bytes);
  memory.fill(at, 0, bytes);
  return at;
}

export function mark(): usize {
  return top;
}

export function release(to: usize): void {
  top = to;
}
