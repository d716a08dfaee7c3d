// What a run is called: the end of its address, but an upload by the name that its file had.

import { get } from "../core/api.js";

const MADE_UP = /^upload-\d{8}-\d{6}-/; // what the server calls an uploaded file
const NUMBER = /^\d+(\.\w+)?$/; // as folders and files of data sets are called: says something after its folder alone
const uploads = new Map(); // the name of each by its address, the made-up one while that is asked for

// `renew` is called once the name of an upload is known.
export function titleOf(uri, renew = () => {}) {
  const parts = (uri ?? "").split("?")[0].split("/").filter(Boolean);
  const last = parts.pop() ?? "";
  if (MADE_UP.test(last)) {
    if (!uploads.has(uri)) ask(uri, last, renew);
    return uploads.get(uri);
  }
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
    // It keeps its made-up name.
  }
}
