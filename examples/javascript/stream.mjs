// Follow set-points that move: node stream.mjs URL TOKEN [PIXELS]
//
// What the cameras see now is the first set-point; then it moves to the right by so many pixels, in two seconds.

import { Cell, run } from "./cell.mjs";

const RATE_HZ = 30, STEPS = 60;
const sleep = (seconds) => new Promise((done) => setTimeout(done, 1000 * seconds));

await run(async ([url, token, pixels = "5"]) => {
  const cell = await Cell.open(url);
  try {
    await cell.ask("take", { token });
    await cell.ask("enable");
    const seen = {};
    await cell.listen(({ features }) => {
      if (features && features.ids.length >= 4) seen[features.camera] = features.ids.map((id, k) => [id, features.pixels[k]]);
      return Object.keys(seen).length === cell.info.cameras.length;
    });
    const moved = (shift) => ({
      kind: "features",
      set_points: Object.fromEntries(Object.entries(seen).map(([camera, markers]) =>
        [camera, Object.fromEntries(markers.map(([id, [u, v]]) => [id, [u + shift, v]]))])),
    });
    // It would be reached at once, at the first set-point: it is to be held for longer than the stream takes.
    const goal = { id: crypto.randomUUID(), target: moved(0), hold_frames: 1000 };
    const end = cell.ended(goal.id);
    await cell.ask("send", { goal });
    for (let k = 1; k <= STEPS; k += 1) {
      await cell.ask("update", { id: goal.id, target: moved((Number(pixels) * k) / STEPS), stamp_s: performance.now() / 1000 });
      await sleep(1 / RATE_HZ);
    }
    const { state } = await cell.listen(({ state }) => state);
    console.log(`followed ${STEPS} set-points, ${state.error_px} px from the last one`);
    await cell.ask("cancel");
    await end;
  } finally {
    cell.close();
  }
});
