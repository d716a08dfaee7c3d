// The title of a run: the end of its address, with the number of a simulated drive; for an upload the name of its file.

import { get } from "../core/api.js";

const MADE_UP = /^upload-\d{8}-\d{6}-/; // prefix that the server gives to uploaded files
const NUMBER = /^\d+(\.\w+)?$/; // a number needs the name of its folder
const uploads = new Map(); // titles by address

// `renew` is called when the name of an upload has arrived.
export function titleOf(uri, renew = () => {}) {
  const [place, query] = (uri ?? "").split("?"), parts = place.split("/").filter(Boolean);
  const last = parts.pop() ?? "";
  if (MADE_UP.test(last)) {
    if (!uploads.has(uri)) ask(uri, last, renew);
    return uploads.get(uri);
  }
  const drive = last.startsWith("sim:") ? Number(new URLSearchParams(query).get("drive")) : 0;
  if (drive) return `${last}, drive ${drive}`;
  return NUMBER.test(last) && parts.length ? `${parts.pop()}/${last}` : last;
}

async function ask(uri, last, renew) {
  uploads.set(uri, last);
  try {
    const known = (await get("/api/sources")).recordings.find((each) => each.uri === uri);
    if (!known) return;
    uploads.set(uri, known.name);
    renew();
  } catch {
    // The list of recordings may be forbidden for this link: the title stays the name on the server.
  }
}
