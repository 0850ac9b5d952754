
// ---- live ------------------------------------------------------------------------------------

let news = false;
function take(message) {
  if (message.mark) addMark(message.mark);
  if (message.mark?.kind === "gap" && torqueTable.t.length) { // no line across it
    for (const table of [torqueTable, bandTable])
      table.push(message.mark.t, table.rows[0].map(() => NaN));
  }
  if (message.t === undefined) return;
  if (!motion.t.length) slider.min = clock.start = clock.time = data.start = message.t;
  motion.push(message.t, message.q);
  if (message.tau && message.at > bandTable.end) { // delayed by the filter; new
    const predicted = message.predicted.map((x) => (x === null ? NaN : x)); // a joint at rest
    torqueTable.push(message.at, [...message.tau, ...predicted]);
    bandTable.push(message.at, [...message.theta, ...message.std_error]);
  }
  clock.end = motion.end;
  slider.max = clock.end;
  news = true;
}

function refresh() { // the charts of a live page that are in sight, a few times a second
  if (news) {
    measureTorques();
    placeMarks();
    refreshCharts();
  }
  news = false;
}

function listen() {
  const source = new EventSource("events");
  const state = (text) => { byId("state").textContent = text; };
  source.onopen = () => state("live");
  source.onmessage = (event) => JSON.parse(event.data).forEach(take);
  source.addEventListener("end", () => {
    source.close();
    refresh();
    refreshCharts(true); // no news will draw them when they are scrolled to
    if (clock.follow) clock.time = clock.end;
    show();
    state("the tracker has finished");
  });
  source.onerror = () => state("no connection to the tracker");
  setInterval(refresh, 250);
}
