// Requests to the server. A refusal becomes an Error whose message is for people.

export const request = async (path, options = {}) => (await answered(path, options)).json().catch(() => null);

async function answered(path, options) {
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...options });
  } catch {
    throw new Error("The server does not answer. Is stemmap still running?");
  }
  if (!answer.ok) throw new Error(wording(await answer.json().catch(() => null), answer.status));
  return answer;
}

function wording(body, status) {
  const error = body?.error;
  if (!error?.what) return `The server answered ${status}.`;
  const place = error.where ? ` (${error.where})` : "";
  return `${error.what}${place}. ${error.remedy ?? ""}`.trim();
}

export const post = (path, body) =>
  request(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

export const patch = (path, body) =>
  request(path, { method: "PATCH", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

export const put = (path, body) =>
  request(path, { method: "PUT", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

// Bytes instead of JSON.
export const block = async (path, options = {}) => (await answered(path, options)).arrayBuffer();
export const blockFor = (path, body) =>
  block(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

export const get = (path) => request(path);
export const open = (uri, odometry, chosen = {}) => post("/api/open", { uri, odometry, seed: 0, ...chosen });

// Commands go one after the other, so that two quick steps are two steps.
let last = Promise.resolve();
export function command(type, fields = {}) {
  last = last.catch(() => {}).then(() => post("/api/command", { type, ...fields }));
  return last;
}
