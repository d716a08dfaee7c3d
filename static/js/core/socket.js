// A WebSocket that reconnects by itself, waiting longer after each failure.

const FIRST_WAIT = 500, LONGEST_WAIT = 5000, REFUSED_WAIT = 30_000; // [ms]
const ANSWER_WAIT = 5000; // [ms]

// Returns whether the server refuses this page. The status of a refused WebSocket handshake is not available to JavaScript, so that
// another request is sent.
async function isRefused() {
  try {
    return [401, 403].includes((await fetch("/api/access", { cache: "no-store", signal: AbortSignal.timeout(ANSWER_WAIT) })).status);
  } catch {
    return false; // no answer
  }
}

// Calls `onMessage` with each JSON message, `onOpen` and `onClose` with each change of the connection, and `onRefused` if the server
// refuses this page. Returns `send`.
export function connectTo(path, { onMessage, onOpen, onClose, onRefused }) {
  let socket = null, wait = FIRST_WAIT;

  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}${path}`);
    socket.onopen = () => {
      wait = FIRST_WAIT;
      onOpen();
    };
    socket.onmessage = (event) => onMessage(JSON.parse(event.data));
    socket.onclose = async () => {
      onClose();
      if (await isRefused()) {
        onRefused();
        setTimeout(connect, REFUSED_WAIT); // the link may be opened in another tab
        return;
      }
      setTimeout(connect, wait);
      wait = Math.min(2 * wait, LONGEST_WAIT);
    };
  }

  connect();
  // Returns whether the message could be sent.
  return (message) => {
    if (socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  };
}
