// Print what a cell publishes for a while: node watch.mjs URL [SECONDS]

import { Cell, run } from "./cell.mjs";

await run(async ([url, seconds = "5"]) => {
  const cell = await Cell.open(url);
  const until = Date.now() + 1000 * Number(seconds);
  await cell.listen(({ state, features, event }) => {
    if (event) console.log("event", event.seq, event.kind, event.message);
    else if (features) console.log("features", features.camera, features.ids.length, "markers");
    else if (state) console.log("state", state.lifecycle, state.goal || "no goal", state.error_px);
    return Date.now() > until;
  });
  cell.close();
});
