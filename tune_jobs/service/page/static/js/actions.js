// What is done with a sweep: each asks the service, and shows what it says when it refuses.
import { ask, ofSweep } from "./api.js";
import { pointDialog, takesPoints } from "./chosen_point.js";
import { askInDialog } from "./dialogs.js";
import { el, toast } from "./dom.js";
import { counted } from "./format.js";
import { toldExtension, toldRace } from "./growth.js";
import { isDone, isLive, isWaiting } from "./states.js";
import { mayChange } from "./who.js";

// `state()` is the sweep's summary, `data` all that is known of it. `onDone()` is called after a change, `onGone()` after
// the sweep is deleted.
export function makeActions({ state, data, alert, onDone, onGone }) {
  const name = () => state().name;
  const post = (verb, body) => ask(ofSweep(name(), `/${verb}`), { method: "POST", body });

  async function direct(verb, told) {
    alert.hide();
    try {
      await post(verb);
      toast(told);
    } catch (error) {
      alert.show(error);
    }
    onDone();
  }

  const inDialog = (dialog) =>
    askInDialog({
      ...dialog,
      act: async (values) => {
        await dialog.act(values);
        onDone();
      },
    });

  const acts = {
    stop: () => direct("stop", `${name()}: its trials save, then it stops.`),
    resume: () => direct("resume", `${name()} waits for its turn.`),
    retry: () => direct("retry", `${name()}: the failed trials run again when its turn has come.`),
    extend: () =>
      inDialog({
        title: `Extend ${name()}`,
        text: "More points are drawn, and trained. The points that there are stay.",
        label: "Extend",
        fields: [
          {
            name: "num_samples",
            label: "More samples",
            type: "number",
            value: 4,
            min: 1,
            max: 100000,
            hint: "Random draws for each combination of the grids.",
          },
        ],
        tell: ({ num_samples: more }) => toldExtension(data.spec, more),
        act: async (values) => {
          await post("extend", values);
          toast(`${name()}: the new points are trained when their turn has come.`);
        },
      }),
    inject: () =>
      inDialog(
        pointDialog({
          name: name(),
          spec: data.spec,
          trials: data.trials,
          post: async (body) => {
            await post("trials", body);
            toast(`${name()}: the point is trained when its turn has come.`);
          },
        }),
      ),
    replicate: () =>
      inDialog({
        title: `Replicate the leaders of ${name()}`,
        text: "The leading settings are trained again with fresh seeds, which tells luck from a good setting.",
        label: "Replicate",
        fields: [
          {
            name: "top",
            label: "Settings",
            type: "number",
            value: 5,
            min: 2,
            max: 1000,
            hint: "How many of the leading settings race.",
          },
          {
            name: "seeds",
            label: "Seeds",
            type: "number",
            value: 5,
            min: 1,
            max: 1000,
            hint: "How many more seeds a setting gets at most.",
          },
        ],
        tell: (values) => toldRace(new Set(data.trials.map((trial) => trial.point_index)).size, values),
        act: async (values) => {
          await post("replicate", values);
          toast(`${name()}: the leaders are trained again when their turn has come.`);
        },
      }),
    edit: () => {
      const { note, tags, job } = state();
      // Only what waits for its turn has one.
      const waits = job?.state === "waiting";
      inDialog({
        title: `${waits ? "Note, tags and priority" : "Note and tags"} of ${name()}`,
        label: "Save",
        fields: [
          { name: "note", label: "Note", type: "textarea", value: note, max: 2000 },
          {
            name: "tags",
            label: "Tags",
            type: "text",
            value: tags.join(", "),
            max: 1000,
            hint: "Separated by commas.",
          },
          ...(waits
            ? [
                {
                  name: "priority",
                  label: "Priority",
                  type: "number",
                  value: job.priority,
                  min: -100,
                  max: 100,
                  hint: "Higher ones go first among those that wait.",
                },
              ]
            : []),
        ],
        act: (values) =>
          ask(ofSweep(name()), {
            method: "PATCH",
            body: {
              note: values.note,
              tags: tagsOf(values.tags),
              ...(waits && values.priority !== job.priority ? { priority: values.priority } : {}),
            },
          }),
      });
    },
    remove: () => {
      const isFinished = state().state === "completed";
      askInDialog({
        title: `Delete ${name()}?`,
        text: "All that it has made goes with it: trials, checkpoints, films, the report. There is no way back.",
        label: "Delete",
        isDangerous: true,
        fields: isFinished
          ? []
          : [{ name: "force", label: "Delete it though it has not finished", type: "checkbox", value: false }],
        act: async ({ force = false }) => {
          await ask(ofSweep(name()), { method: "DELETE", query: force ? { force: "true" } : {} });
          toast(`${name()} is deleted.`);
          onGone();
        },
      });
    },
  };

  const button = (key, label, kind = null) =>
    el("button", { type: "button", class: kind, dataset: { action: key }, onclick: () => acts[key]() }, label);
  const menu = el(
    "div",
    { class: "menu", popover: "auto", id: "more-actions", role: "group", "aria-label": "More actions" },
    button("extend", "Extend…"),
    button("inject", "Add a point…"),
    button("replicate", "Replicate leaders…"),
    button("retry", "Retry failed trials"),
    el("hr"),
    button("edit", "Note, tags, priority…"),
    el("hr"),
    button("remove", "Delete…", "bad-text"),
  );
  const more = el("button", { type: "button", popovertarget: "more-actions", "aria-haspopup": "true" }, "More");
  menu.addEventListener("toggle", (event) => {
    if (event.newState !== "open") return;
    const box = more.getBoundingClientRect();
    menu.style.top = `${box.bottom + 4}px`;
    menu.style.left = `${Math.max(8, Math.min(box.right - menu.offsetWidth, innerWidth - menu.offsetWidth - 8))}px`;
  });
  // Before what was chosen opens a dialog, which gives the focus back to where it was.
  menu.addEventListener(
    "click",
    (event) => {
      if (!event.target.closest("button")) return;
      menu.hidePopover();
      more.focus();
    },
    { capture: true },
  );
  const follow = () => {
    if (menu.matches(":popover-open")) menu.hidePopover();
  };
  addEventListener("scroll", follow, { passive: true });
  const main = { stop: button("stop", "Stop"), resume: button("resume", "Resume") };
  const node = el(
    "div",
    { class: "actions", role: "group", "aria-label": "Actions" },
    main.stop,
    main.resume,
    more,
    menu,
  );

  return {
    node,
    show() {
      const sweep = state();
      node.hidden = !mayChange(sweep);
      const live = isLive(sweep) || isWaiting(sweep);
      const focused = document.activeElement;
      main.stop.hidden = !live || Boolean(sweep.job?.stop_requested);
      main.resume.hidden = live || isDone(sweep);
      // Who has just pressed what is gone now goes on beside it.
      if (focused?.hidden && node.contains(focused)) [main.resume, main.stop, more].find((other) => !other.hidden).focus();
      const failed = sweep.counts.failed ?? 0;
      const retry = menu.querySelector('[data-action="retry"]');
      retry.hidden = failed === 0;
      retry.textContent = `Retry ${counted(failed, "failed trial")}`;
      menu.querySelector('[data-action="inject"]').hidden = !takesPoints(data.spec);
    },
    close: () => removeEventListener("scroll", follow),
  };
}

export const tagsOf = (text) => [
  ...new Set(
    text
      .split(",")
      .map((tag) => tag.trim())
      .filter(Boolean),
  ),
];
