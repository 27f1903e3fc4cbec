// Lets the site's search run when its pages are opened from disk, where browsers refuse to start a Worker.
//
// The search script runs in a hidden frame instead, and gets and sends the same messages as in a Worker. Material for
// MkDocs loads this file first (`extra.polyfills` in mkdocs.yml); its search script asks for `IFrameWorker` by name to
// find its own address. Where pages come from a server, nothing is replaced.

class IFrameWorker extends EventTarget {
  constructor(address) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.append(frame);
    const inside = frame.contentWindow;
    this.inside = inside;
    const send = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
    inside.postMessage = (data) => setTimeout(send, 0, data);
    inside.importScripts = (...scripts) =>
      scripts.reduce((before, script) => before.then(() => load(inside.document, script)), Promise.resolve());
    this.loaded = load(inside.document, address);
  }

  postMessage(data) {
    this.loaded.then(() => this.inside.dispatchEvent(new this.inside.MessageEvent("message", { data })));
  }

  terminate() {
    this.inside.frameElement.remove();
  }
}

function load(page, address) {
  return new Promise((done, failed) => {
    const script = page.createElement("script");
    script.src = address;
    script.onload = done;
    script.onerror = failed;
    page.body.append(script);
  });
}

if (location.protocol === "file:") {
  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
}
