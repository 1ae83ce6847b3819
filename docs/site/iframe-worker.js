// Runs workers in frames where a page comes from a disk, on which browsers allow
// none: so the search works without a server. The theme looks for a script of
// this name (its plugin `offline` would load one from a network).
if (location.protocol === 'file:') {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.onerror = null;
      this.frame = document.createElement('iframe');
      this.frame.hidden = true;
      document.body.appendChild(this.frame);
      const inside = this.frame.contentWindow;
      inside.document.open();
      inside.document.write(`<html><body><script>
        postMessage = data => parent.postMessage(data, '*');
        importScripts = (...urls) => urls.reduce((before, url) =>
          before.then(() => new Promise(resolve => {
            const script = document.createElement('script');
            script.src = url;
            script.onload = resolve;
            document.body.appendChild(script);
          })), Promise.resolve());
        <\/script><script src="${url}"><\/script></body></html>`);
      inside.document.close();
      this.hear = event => {
        if (event.source !== inside) return;
        const message = new MessageEvent('message', {data: event.data});
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      };
      window.addEventListener('message', this.hear);
      this.ready = new Promise(resolve => {
        this.frame.addEventListener('load', resolve);
      });
    }

    postMessage(data) {
      this.ready.then(() => {
        const message = new MessageEvent('message', {data});
        this.frame.contentWindow.dispatchEvent(message);
      });
    }

    terminate() {
      window.removeEventListener('message', this.hear);
      this.frame.remove();
    }
  };
}
