// A cell over the WebSocket of `stereoservo web`: docs/web.md has every message. Node 22 has a WebSocket of its own,
// node 20 with --experimental-websocket; elsewhere `npm install ws`.

const WebSocket = globalThis.WebSocket ?? (await import("ws")).WebSocket;

export class Refused extends Error {}

export class Cell {
  // url: as `stereoservo web` prints it, http://127.0.0.1:8080/
  static async open(url) {
    const socket = new WebSocket(new URL("socket", url.replace(/^http/, "ws")));
    socket.binaryType = "arraybuffer"; // pictures; not read here
    const cell = new Cell(socket);
    await new Promise((opened, failed) => {
      socket.addEventListener("open", opened);
      socket.addEventListener("error", () => failed(new Error(`${url} does not answer, or is no page of a cell`)));
    });
    return cell;
  }

  constructor(socket) {
    this.socket = socket;
    this.number = 0;
    this.answers = new Map();
    this.listeners = new Set();
    socket.addEventListener("message", ({ data }) => { if (typeof data === "string") this.take(JSON.parse(data)); });
    socket.addEventListener("close", () => {
      const gone = new Error("the page's server is gone; what it had started stops");
      for (const { failed } of this.answers.values()) failed(gone);
      for (const listener of [...this.listeners]) listener(null, gone);
    });
  }

  take(message) {
    if (message.answer) {
      const { n, ok } = message.answer;
      const waiting = this.answers.get(n);
      this.answers.delete(n);
      if (ok) waiting?.settle(message.answer);
      else waiting?.failed(new Refused(message.answer.message));
    } else {
      if (message.info) this.info = message.info; // cameras, joints, laws, taught goals: sent once at the start
      for (const listener of [...this.listeners]) listener(message);
    }
  }

  // Ask for something by its verb; throws Refused, with the reason, where it was not done.
  ask(verb, fields = {}) {
    const n = ++this.number;
    return new Promise((settle, failed) => {
      this.answers.set(n, { settle, failed });
      this.socket.send(JSON.stringify({ do: verb, n, ...fields }));
    });
  }

  // Every message that comes, until `listener` returns true.
  listen(listener) {
    return new Promise((settle, failed) => {
      const heard = (message, error) => {
        if (error) failed(error);
        else if (listener(message)) { this.listeners.delete(heard); settle(message); }
      };
      this.listeners.add(heard);
    });
  }

  // The event that ends a goal, which is awaited from before it is sent: it may end at once.
  ended(id) {
    const last = new Set(["goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted"]);
    return this.listen(({ event }) => event && event.id === id && last.has(event.kind)).then(({ event }) => event);
  }

  close() {
    this.listeners.clear();
    this.socket.close();
  }
}

// Run a program, and end it with its refusal in words.
export async function run(program) {
  try {
    await program(process.argv.slice(2));
  } catch (error) {
    console.error(error instanceof Refused ? `refused: ${error.message}` : error.message);
    process.exitCode = 1;
  }
}
