// Search when a page is opened from the disk: browsers start no worker there, so its script runs in a hidden frame that stands for it.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.append(frame)
      const inner = frame.contentWindow
      this.frame = frame
      this.ready = new Promise(resolve => {
        inner.postMessage = data => {
          const event = new MessageEvent("message", {data})
          this.dispatchEvent(event)
          if (this.onmessage) this.onmessage(event)
        }
        const script = inner.document.createElement("script")
        script.onload = resolve
        script.src = new URL(url, location.href)
        inner.document.head.append(script)
      })
    }
    postMessage(data) {
      this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", {data})))
    }
    terminate() {
      this.frame.remove()
    }
  }
}
