// Search runs in a Worker, and browsers start none for a page that is a file. For such a page the script of the worker
// runs in a hidden frame instead, which exchanges messages with the page in the same way.
if (location.protocol === "file:") {
  const STARTED = "the script of the worker has started";

  const inside = (url) => `<body><script>
    postMessage = (data) => parent.postMessage(data, "*");
    importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((done) => {
      const script = document.createElement("script");
      script.src = url;
      script.onload = done;
      document.body.appendChild(script);
    })), Promise.resolve());
  </script><script src="${url}"></script><script>postMessage("${STARTED}")</script></body>`;

  // The theme's script looks for the first of these names.
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = []; // messages to a script that has not started
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      window.addEventListener("message", (event) => this.receive(event));
      document.body.appendChild(this.frame);
      const page = this.frame.contentDocument;
      page.open();
      page.write(inside(url));
      page.close();
    }

    receive(event) {
      if (event.source !== this.frame.contentWindow) return;
      if (event.data === STARTED) {
        const messages = this.waiting;
        this.waiting = null;
        messages.forEach((message) => this.postMessage(message));
        return;
      }
      this.dispatchEvent(new MessageEvent("message", { data: event.data }));
    }

    postMessage(message) {
      if (this.waiting) this.waiting.push(message);
      else this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data: message }));
    }

    terminate() {
      this.frame.remove();
    }
  };
}
