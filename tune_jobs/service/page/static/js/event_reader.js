// Server-sent events that have an end, by fetch: an EventSource does not say why it was refused, asks anew where it has
// come to the end, and can't be held up.
import { answerTo, Unreachable } from "./api.js";

// Yields [kind, data]; who stops taking them holds up the service, too.
export async function* eventsOf(path, options) {
  const answer = await answerTo(path, { ...options, headers: { Accept: "text/event-stream" } });
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  try {
    for (;;) {
      const { done, value } = await reader.read().catch((error) => {
        throw error.name === "AbortError" ? error : new Unreachable();
      });
      if (done) return;
      text += value;
      for (let end = text.indexOf("\n\n"); end >= 0; end = text.indexOf("\n\n")) {
        const event = eventOf(text.slice(0, end));
        text = text.slice(end + 2);
        if (event) yield event;
      }
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

function eventOf(block) {
  let kind = "message";
  const data = [];
  for (const line of block.split("\n")) {
    if (line.startsWith("event: ")) kind = line.slice(7);
    else if (line.startsWith("data: ")) data.push(line.slice(6));
  }
  return data.length ? [kind, JSON.parse(data.join("\n"))] : null;
}
