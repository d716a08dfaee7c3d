// A WebSocket that reconnects by itself, waiting longer after each failure.

const FIRST_WAIT = 500, LONGEST_WAIT = 5000; // [ms]

// Calls `onMessage` with each JSON message, `onOpen` and `onClose` with each change of the connection. Returns `send`.
export function connectTo(path, { onMessage, onOpen, onClose }) {
  let socket = null, wait = FIRST_WAIT;

  function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}${path}`);
    socket.onopen = () => {
      wait = FIRST_WAIT;
      onOpen();
    };
    socket.onmessage = (event) => onMessage(JSON.parse(event.data));
    socket.onclose = () => {
      onClose();
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
