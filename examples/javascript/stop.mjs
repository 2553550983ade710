// Stop the arm, which needs no token: node stop.mjs URL

import { Cell, run } from "./cell.mjs";

await run(async ([url]) => {
  const cell = await Cell.open(url);
  console.log("stopped:", (await cell.ask("stop")).message);
  cell.close();
});
