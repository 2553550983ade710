// Plan a taught goal, go there, wait for its end: node goal.mjs URL TOKEN NAME

import { Cell, run } from "./cell.mjs";

await run(async ([url, token, name]) => {
  const cell = await Cell.open(url);
  try {
    await cell.ask("take", { token });
    await cell.ask("enable");
    const goal = { id: crypto.randomUUID(), target: { kind: "taught", name } };
    const { plan } = await cell.ask("check", { goal }); // nothing moves
    if (plan) console.log(`planned ${plan.seconds.toFixed(1)} s`);
    const end = cell.ended(goal.id);
    await cell.ask("send", { goal }); // its lease is renewed by the server while this connection is open
    const { kind, error_px, message } = await end;
    console.log(kind.replace("goal_", ""), error_px, "px", message);
    if (kind !== "goal_reached") process.exitCode = 1;
  } finally {
    cell.close();
  }
});
