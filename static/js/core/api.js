// Requests to the server. A refused or failed request throws an Error whose message is shown to people.

const headers = { "Content-Type": "application/json" };
const send = (method) => (path, body) => request(path, { method, headers, body: JSON.stringify(body) });

export const request = async (path, options = {}) => (await answered(path, options)).json().catch(() => null);

async function answered(path, options) {
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...options });
  } catch {
    throw new Error("The server does not answer. Check that stemmap is still running.");
  }
  if (!answer.ok) throw new Error(wording(await answer.json().catch(() => null), answer.status));
  return answer;
}

function wording(body, status) {
  const error = body?.error;
  if (!error?.what) return `The server answered with status ${status}. Try again, or see its log.`;
  const place = error.where ? ` (${error.where})` : "";
  return `${error.what}${place}. ${error.remedy ?? ""}`.trim();
}

export const get = (path) => request(path);
export const post = send("POST");
export const patch = send("PATCH");
export const put = send("PUT");
export const remove = (path) => request(path, { method: "DELETE" });

// Answers as bytes.
export const block = async (path, options = {}) => (await answered(path, options)).arrayBuffer();
export const blockFor = (path, body) =>
  block(path, { method: "POST", headers, body: JSON.stringify(body) });

// Opens a run. A source request is {uri, odometry, seed, topics, mount, preset, parameters}, all but `uri` optional.
export const open = (source) => post("/api/open", source);
// Checks whether it could be opened; the open run stays.
export const check = (source) => post("/api/open?check_only=true", source);

// Commands are sent one at a time, so that two quick steps are two steps.
let last = Promise.resolve();
export function command(type, fields = {}) {
  last = last.catch(() => {}).then(() => post("/api/command", { type, ...fields }));
  return last;
}
