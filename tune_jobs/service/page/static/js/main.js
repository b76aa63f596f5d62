// The page: its bar, and the view that the address names.
import { ask } from "./api.js";
import { openCompare } from "./compare_view.js";
import { el, setText, speak } from "./dom.js";
import { takeFiles } from "./file_drop.js";
import { openFile } from "./file_view.js";
import { counted } from "./format.js";
import { read } from "./route.js";
import { openLogin } from "./login.js";
import { openNew } from "./new_view.js";
import { openPlay } from "./play_view.js";
import { openSweep } from "./sweep_view.js";
import { openSweeps } from "./sweeps_view.js";
import { me } from "./who.js";

const VIEWS = {
  sweeps: openSweeps,
  sweep: openSweep,
  play: openPlay,
  new: openNew,
  compare: openCompare,
  file: openFile,
};
const main = document.getElementById("main");
let open = null;
let isSigningIn = false;

function heading(route) {
  const { name, view } = route;
  const named = { sweep: name, play: `Watch ${name}` };
  return { sweeps: "Sweeps", new: "New sweep", compare: "Compare", file: "Sweep file", ...named }[view];
}

function show() {
  const route = read();
  // A file is the reader's own: nobody is asked for it.
  if (isSigningIn && route.view !== "file") {
    signIn();
    return;
  }
  const isSame = open && open.route.view === route.view && open.route.name === route.name;
  if (isSame && open.view.follow) {
    open.view.follow(route.params);
    return;
  }
  const isFirst = open === null;
  open?.view.close();
  main.replaceChildren();
  document.title = `${heading(route)} · tune-jobs`;
  for (const link of document.querySelectorAll(".bar nav a")) {
    const isHere = link.dataset.view === (["new", "file"].includes(route.view) ? route.view : "sweeps");
    if (isHere) link.setAttribute("aria-current", route.view === link.dataset.view ? "page" : "true");
    else link.removeAttribute("aria-current");
  }
  open = { route, view: VIEWS[route.view](main, route) };
  scrollTo(0, 0);
  if (!isFirst) {
    // A reader of the screen hears where they are now.
    main.focus({ preventScroll: true });
    speak(heading(route));
  }
}

function tellWho(found) {
  const cpus = found.num_cpus ? counted(found.num_cpus, "CPU") : found.address ? `cluster ${found.address}` : "";
  const who = found.name === "local" ? "" : `${found.name}, ${found.role}`;
  setText(document.getElementById("where"), [who, cpus].filter(Boolean).join(" · "));
  document.getElementById("log-out").hidden = found.name === "local";
}

async function begin() {
  if (open === null && read().view === "file") show();
  try {
    Object.assign(me, await ask("me"));
    tellWho(me);
  } catch (error) {
    if (error.status === 401) return;
    setTimeout(begin, 3000);
    if (open?.route.view === "file") return;
    open?.view.close();
    open = null;
    main.replaceChildren(
      el(
        "div",
        { class: "notice bad", role: "alert" },
        el("p", {}, error.message),
        el("p", { class: "quiet" }, error.hint ?? ""),
      ),
    );
    return;
  }
  show();
}

function signIn() {
  open?.view.close();
  open = null;
  openLogin(main, () => {
    isSigningIn = false;
    document.body.classList.remove("signing-in");
    main.replaceChildren();
    begin();
  });
}

addEventListener("sign-in-needed", () => {
  if (isSigningIn) return;
  isSigningIn = true;
  document.body.classList.add("signing-in");
  show();
});
addEventListener("hashchange", show);
document.getElementById("log-out").addEventListener("click", async () => {
  await ask("logout", { method: "POST" }).catch(() => {});
  location.reload();
});
document.getElementById("skip").addEventListener("click", (event) => {
  // The fragment is the view's address, not a place on the page.
  event.preventDefault();
  main.focus();
});
takeFiles();
begin();
