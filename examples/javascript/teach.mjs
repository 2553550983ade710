// What the cameras see now becomes a goal: node teach.mjs URL TOKEN NAME

import { Cell, run } from "./cell.mjs";

await run(async ([url, token, name]) => {
  const cell = await Cell.open(url);
  try {
    await cell.ask("take", { token });
    await cell.ask("teach", { name });
    console.log("taught", name);
  } finally {
    cell.close();
  }
});
