/* Browsers refuse workers to pages that are read from a folder. There, the search's worker runs in a hidden frame. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      this.inside = frame.contentWindow;
      this.ready = new Promise(resolve => {
        this.inside.document.open();
        this.inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }));
        this.inside.loaded = resolve;
        this.inside.document.write(`<script src="${url}" onload="loaded()"><\/script>`);
        this.inside.document.close();
      });
    }

    postMessage(data) {
      this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {}
  };
}
