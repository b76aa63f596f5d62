// A sweep from a file, to be looked at alone; without one the view asks for it.
import { el } from "./dom.js";
import { chooseFile, opened, OPENED } from "./file_drop.js";
import { FileSource } from "./file_source.js";
import { moment } from "./format.js";
import { openSweep } from "./sweep_view.js";

const chooser = (label, kind = null) => el("button", { type: "button", class: kind, onclick: chooseFile }, label);

function asking() {
  return [
    el("div", { class: "title-row" }, el("h1", {}, "Sweep file")),
    el(
      "div",
      { class: "card empty ask-file" },
      el("p", { class: "strong" }, "Drop the file of a sweep anywhere on this page"),
      chooser("Open a file…", "primary"),
      el(
        "p",
        { class: "quiet small" },
        "A sweep is saved as a file on its page, or by ",
        el("code", {}, "tune-jobs export SWEEP --format sweep"),
        ". Whoever gets it looks at curves, trials and what mattered. It stays in this browser: nothing is sent.",
      ),
    ),
  ];
}

function told({ file, fileName }) {
  const when =
    file.status.state === "running" ? `It was running; this is how it was on ${moment(file.as_of)}.` : "";
  return el(
    "div",
    { class: "notice from-file", role: "note" },
    el(
      "p",
      {},
      "From the file ",
      el("b", {}, fileName),
      `, to look at alone: it is read by this browser, and nothing is sent. ${when}`,
    ),
    chooser("Open another file…"),
  );
}

export function openFile(main, route) {
  let view = null;

  function show(params) {
    view?.close();
    view = null;
    if (opened.file === null) {
      main.replaceChildren(...asking());
      return;
    }
    main.replaceChildren(told(opened));
    document.title = `${opened.file.sweep.name} · file · tune-jobs`;
    view = openSweep(main, { ...route, params: { ...params } }, new FileSource(opened.file));
  }

  const another = () => show({});
  addEventListener(OPENED, another);
  show(route.params);
  return {
    follow: (params) => view?.follow(params),
    close() {
      removeEventListener(OPENED, another);
      view?.close();
    },
  };
}
