// When work is done: not too often, once per frame, or one request at a time.

// A function that calls `work` at most once per `pause` [ms] (a number or a function): the last call is never dropped.
// `.now()` calls it at once.
export function throttled(work, pause) {
  let timer = 0, ranAt = -Infinity;
  const now = () => {
    clearTimeout(timer);
    timer = 0;
    ranAt = performance.now();
    return work();
  };
  const later = () => {
    const wait = typeof pause === "function" ? pause() : pause;
    timer ||= setTimeout(now, Math.max(0, wait - (performance.now() - ranAt)));
  };
  return Object.assign(later, { now });
}

// A function that calls `draw` in the next animation frame, however often it is called before.
export function oncePerFrame(draw) {
  let planned = false;
  return () => {
    if (planned) return;
    planned = true;
    requestAnimationFrame(() => { planned = false; draw(); });
  };
}

// A function that runs the asynchronous `work` after each call, one run at a time and `pause` [ms] (a number or a function)
// between two runs.
export function keepFresh(work, pause) {
  let busy = false, wanted = false;
  return async () => {
    wanted = true;
    if (busy) return;
    busy = true;
    while (wanted) {
      wanted = false;
      await work();
      await new Promise((resolve) => setTimeout(resolve, typeof pause === "function" ? pause() : pause));
    }
    busy = false;
  };
}

// A function that sends values one at a time; while one is on its way only the newest waits.
export function newestFirst(send) {
  let waiting = null, busy = false;
  const put = async (value) => {
    waiting = { value };
    if (busy) return;
    busy = true;
    while (waiting) {
      const next = waiting.value;
      waiting = null;
      await send(next);
    }
    busy = false;
  };
  return Object.assign(put, { isBusy: () => busy });
}
