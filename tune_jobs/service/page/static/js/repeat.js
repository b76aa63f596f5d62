// Ask again and again: at once when the page is seen again, seldom while nobody looks, later when asking takes long.
const HIDDEN_MS = 30_000;
const MOST_MS = 30_000;

export function repeat(act, pauseMs) {
  let timer = 0;
  let failures = 0;
  let isClosed = false;
  let running = null;

  async function once() {
    clearTimeout(timer);
    const began = performance.now();
    try {
      await act();
      failures = 0;
    } catch {
      // Who asks has shown it.
      failures += 1;
    }
    if (isClosed) return;
    const took = performance.now() - began;
    const wanted = Math.min(MOST_MS, Math.max(pauseMs(), 4 * took) * 2 ** Math.min(failures, 4));
    timer = setTimeout(now, document.hidden ? Math.max(wanted, HIDDEN_MS) : wanted);
  }

  function now() {
    running ??= once().finally(() => {
      running = null;
    });
    return running;
  }

  const seen = () => {
    if (!document.hidden) now();
  };
  document.addEventListener("visibilitychange", seen);
  return {
    now,
    close() {
      isClosed = true;
      clearTimeout(timer);
      document.removeEventListener("visibilitychange", seen);
    },
  };
}
