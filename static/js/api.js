// Requests to the server. A refusal becomes an Error whose message is for people.

export async function request(path, options = {}) {
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...options });
  } catch {
    throw new Error("The server does not answer. Is stemmap still running?");
  }
  const body = await answer.json().catch(() => null);
  if (!answer.ok) throw new Error(wording(body, answer.status));
  return body;
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

export const get = (path) => request(path);
export const open = (uri, odometry) => post("/api/open", { uri, odometry, seed: 0 });

// Commands go one after the other, so that two quick steps are two steps.
let last = Promise.resolve();
export function command(type, fields = {}) {
  last = last.catch(() => {}).then(() => post("/api/command", { type, ...fields }));
  return last;
}
