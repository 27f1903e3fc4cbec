"use strict";
// Each figure is a stack of pictures. Two of them are seen: one left of a line, one right of it. The line is moved by
// mouse, finger or keys; which pictures they are, two lists say.
for (const figure of document.querySelectorAll("figure.compare")) {
  const stage = figure.querySelector(".stage");
  const handle = figure.querySelector(".handle");
  const pictures = [...stage.querySelectorAll("img")];
  let cut = 50;
  let dragging = false;

  const moveTo = (percent) => {
    cut = Math.min(100, Math.max(0, percent));
    stage.style.setProperty("--cut", cut + "%");
    handle.setAttribute("aria-valuenow", Math.round(cut));
  };
  const follow = (event) => {
    const box = stage.getBoundingClientRect();
    moveTo((100 * (event.clientX - box.left)) / box.width);
  };
  stage.addEventListener("pointerdown", (event) => {
    dragging = event.isPrimary && event.button === 0;
    if (!dragging) return;
    event.preventDefault();
    handle.focus({ preventScroll: true });
    follow(event);
  });
  addEventListener("pointermove", (event) => {
    if (dragging && event.isPrimary) follow(event);
  });
  for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => (dragging = false));
  handle.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: -2, ArrowDown: -2, ArrowRight: 2, ArrowUp: 2, PageDown: -10, PageUp: 10, Home: -100, End: 100 };
    if (!(event.key in steps)) return;
    event.preventDefault();
    moveTo(cut + steps[event.key]);
  });

  // Beside them stands what belongs to the picture on the right: its errors. Of a photograph there are none.
  const beside = [...figure.querySelectorAll(".beside img")];
  const lists = ["right", "left"].map((side) => figure.querySelector("select." + side));
  const show = () => {
    for (const list of lists) {
      pictures.forEach((picture, i) => picture.classList.toggle(list.className, i === list.selectedIndex));
    }
    const of = (list) => beside.find((picture) => picture.dataset.of === String(list.selectedIndex));
    const chosen = of(lists[0]) ?? of(lists[1]) ?? beside[0];
    beside.forEach((picture) => picture.classList.toggle("chosen", picture === chosen));
  };
  for (const list of lists) list.addEventListener("change", show);
  show(); // a browser that comes back to the page remembers what was chosen
}
