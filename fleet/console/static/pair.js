// The page of a device that is not paired. The QR code brings the code in the fragment, which browsers send nowhere.

const input = document.getElementById("code");
const answer = document.getElementById("answer");

async function pair(code) {
  answer.textContent = "…";
  try {
    const found = await (await fetch("/pair", { method: "POST", body: code })).json();
    if (found.ok) location.replace("/");
    else answer.textContent = found.words;
  } catch {
    answer.textContent = "The console does not answer.";
  }
}

document.getElementById("pair").addEventListener("submit", (event) => {
  event.preventDefault();
  pair(input.value);
});

function onAddress() {
  const scanned = location.hash.slice(1);
  if (scanned === "") return false;
  history.replaceState(null, "", "/pair");
  input.value = scanned;
  pair(scanned);
  return true;
}

window.addEventListener("hashchange", onAddress);
if (!onAddress()) {
  // A link from another program brings no cookie (SameSite=Strict). This request brings it.
  fetch("/hello")
    .then((response) => response.ok && location.replace("/"))
    .catch(() => {});
}
