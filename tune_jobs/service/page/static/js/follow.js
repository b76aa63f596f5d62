// Keep something up to date: load it, then follow its events; where they end, load it again.
import { address, Refused } from "./api.js";
import { setText } from "./dom.js";

const AGAIN_MS = 1000;
const MOST_MS = 30_000;
const HIDDEN_MS = 20_000;
const BATCH_MS = 250;

function tell(isReached) {
  const box = document.getElementById("link-state");
  box.classList.toggle("lost", !isReached);
  setText(box, isReached ? "" : "Not connected: trying again");
}

// `load()` fetches all and returns the path of the events that continue it; `kinds` are the events that it wants, for
// which `apply(kind, data)` is called; `show(error)` is called after what came, and when loading fails. Events that
// continue nothing may have missed what came before they began: `opened()` then asks once more.
// Returns { close }.
export function follow({ load, kinds, apply, show, opened = null }) {
  let source = null;
  let timer = 0;
  let hiding = 0;
  let batch = 0;
  let failures = 0;
  let isClosed = false;
  let run = 0;

  function end() {
    source?.close();
    source = null;
    clearTimeout(timer);
    clearTimeout(batch);
    batch = 0;
    run += 1;
  }

  async function begin() {
    end();
    const own = run;
    try {
      const path = await load();
      if (own !== run || isClosed) return;
      show(null);
      listen(path);
    } catch (error) {
      if (own !== run || isClosed || error.name === "AbortError") return;
      // A proxy whose service is away answers too.
      tell(error instanceof Refused && error.status < 500);
      show(error);
      later();
    }
  }

  function later() {
    clearTimeout(timer);
    timer = setTimeout(begin, Math.min(MOST_MS, AGAIN_MS * 2 ** failures));
    failures = Math.min(failures + 1, 6);
  }

  function listen(path) {
    source = new EventSource(address(path));
    const own = source;
    for (const kind of kinds) {
      own.addEventListener(kind, (event) => {
        apply(kind, JSON.parse(event.data));
        // What comes close together is drawn together.
        batch ||= setTimeout(() => {
          batch = 0;
          if (!isClosed) show(null);
        }, BATCH_MS);
      });
    }
    own.addEventListener("reset", begin);
    own.addEventListener("open", async () => {
      // Not before: what can be loaded may yet refuse its events.
      failures = 0;
      tell(true);
      if (opened === null) return;
      await opened().catch(() => own === source && begin());
      if (own === source) show(null);
    });
    own.addEventListener("error", () => {
      // The browser connects again by itself, unless it was refused.
      if (own === source && own.readyState === EventSource.CLOSED) {
        source = null;
        tell(false);
        later();
      } else if (own === source) tell(false);
    });
  }

  // Nobody looks: the connection is left to those who do, as a browser has few of them for one service.
  function seen() {
    clearTimeout(hiding);
    if (document.hidden) hiding = setTimeout(end, HIDDEN_MS);
    else if (source === null) begin();
  }

  // A page that the reader has left may be kept for the way back, with its connection.
  const shown = (event) => event.persisted && begin();
  document.addEventListener("visibilitychange", seen);
  addEventListener("pagehide", end);
  addEventListener("pageshow", shown);
  begin();
  return {
    close() {
      isClosed = true;
      end();
      clearTimeout(hiding);
      document.removeEventListener("visibilitychange", seen);
      removeEventListener("pagehide", end);
      removeEventListener("pageshow", shown);
      tell(true);
    },
  };
}
