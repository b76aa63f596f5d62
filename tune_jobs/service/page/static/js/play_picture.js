// What an environment draws: pictures of the step that was told last, however fast they come.
import { el } from "./dom.js";

export class Picture {
  constructor(host) {
    this.canvas = el("canvas", { role: "img", "aria-label": "Nothing is played yet", width: 600, height: 400 });
    this.context = this.canvas.getContext("2d");
    this.next = null;
    this.isBusy = false;
    // Of what is shown: a picture that was begun before is not wanted any more.
    this.run = 0;
    host.append(this.canvas);
  }

  describe(text) {
    this.canvas.setAttribute("aria-label", text);
  }

  clear() {
    this.run += 1;
    this.next = null;
    this.canvas.classList.remove("drawn");
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  // A JPEG as base64. It is decoded from memory: nothing is loaded, and the page's policy stays as strict as it is.
  async show(picture) {
    this.next = picture;
    if (this.isBusy) return;
    this.isBusy = true;
    while (this.next !== null) {
      const { run, next } = this;
      this.next = null;
      const bitmap = await createImageBitmap(new Blob([bytesOf(next)], { type: "image/jpeg" })).catch(() => null);
      if (bitmap === null) continue;
      if (run === this.run) {
        if (this.canvas.width !== bitmap.width) this.canvas.width = bitmap.width;
        if (this.canvas.height !== bitmap.height) this.canvas.height = bitmap.height;
        this.context.drawImage(bitmap, 0, 0);
        this.canvas.classList.add("drawn");
      }
      bitmap.close();
    }
    this.isBusy = false;
  }
}

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let index = 0; index < text.length; index += 1) bytes[index] = text.charCodeAt(index);
  return bytes;
}
