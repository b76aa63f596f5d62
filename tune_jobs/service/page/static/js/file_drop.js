// Opens a sweep's file: one that is dropped anywhere on the page, or one that the reader chooses. It stays in the browser.
import { askInDialog } from "./dialogs.js";
import { el } from "./dom.js";
import { readSweepFile } from "./sweep_file.js";

// What is open; it is kept while the reader looks at other views.
export const opened = { file: null, fileName: "" };
export const OPENED = "sweep-file-opened";

const input = el("input", { type: "file", accept: ".tunejobs,.gz,application/gzip", hidden: true, id: "chosen-file" });
const over = el(
  "div",
  { class: "drop-here", hidden: true },
  el("p", {}, "Drop it to look at the sweep"),
  el("p", { class: "quiet small" }, "The file stays in this browser: nothing is sent."),
);
// The newest one counts, however long an older one takes.
let turn = 0;
let refused = null;

// Let the reader choose a file.
export function chooseFile() {
  input.value = "";
  input.click();
}

async function open(files) {
  const own = (turn += 1);
  refused?.close();
  try {
    if (files.length !== 1) throw new Error(`${files.length} files were given; one is opened at a time.`);
    const file = await readSweepFile(files[0]);
    if (own !== turn) return;
    Object.assign(opened, { file, fileName: files[0].name });
    location.hash = "#/file";
    dispatchEvent(new Event(OPENED));
  } catch (error) {
    if (own !== turn) return;
    refused = askInDialog({
      title: "This file can't be opened",
      text: [error.message, error.hint].filter(Boolean).join(" "),
      label: "Choose another…",
      act: chooseFile,
    });
  }
}

const hasFiles = (event) => event.dataTransfer?.types.includes("Files");

// Take files that are dropped, wherever on the page.
export function takeFiles() {
  document.body.append(input, over);
  input.addEventListener("change", () => input.files.length && open([...input.files]));
  addEventListener("dragenter", (event) => {
    if (hasFiles(event)) over.hidden = false;
  });
  addEventListener("dragover", (event) => {
    if (!hasFiles(event)) return;
    // Otherwise the browser would leave the page for the file.
    event.preventDefault();
    event.dataTransfer.dropEffect = "copy";
  });
  addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) over.hidden = true;
  });
  addEventListener("drop", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    over.hidden = true;
    open([...event.dataTransfer.files]);
  });
}
