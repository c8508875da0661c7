// The search of the site needs a Worker, which browsers refuse to pages of a folder: there its script runs in a frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.waiting = []
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.body.appendChild(frame)
      this.inside = frame.contentWindow
      this.inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
      const script = frame.contentDocument.createElement("script")
      script.src = url
      script.onload = () => {
        for (const data of this.waiting.splice(0)) this.send(data)
        this.postMessage = this.send
      }
      frame.contentDocument.body.appendChild(script)
    }
    postMessage(data) {
      this.waiting.push(data)
    }
    send(data) {
      this.inside.dispatchEvent(new MessageEvent("message", { data }))
    }
  }
}
