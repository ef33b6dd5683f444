// The page of `dsr view`: its data are in it.

function start() {
  try {
    if (typeof DecompressionStream === "undefined") throw new Error("no DecompressionStream");
    new View(block("content"), textOf);
  } catch (error) {
    fall(`The surface cannot be turned in this browser (${error.message}); here it is as pictures. A current Firefox, Chrome, Edge or Safari with WebGL 2 shows it.`);
  }
}

addEventListener("unhandledrejection", (event) => { fall(`The surface could not be read (${event.reason?.message}).`); event.preventDefault(); });
start();
