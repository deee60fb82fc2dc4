"use strict";
// Full-size view of a picture: from what is embedded already, so that it works wherever the page is.
const zoom = document.getElementById("zoom");
const large = zoom.querySelector("img");
document.addEventListener("click", (event) => {
  const opener = event.target.closest("[data-zoom]");
  if (!opener || event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  const small = opener.querySelector("img");
  large.src = small.src;
  large.alt = small.alt;
  large.width = small.naturalWidth;
  large.height = small.naturalHeight;
  zoom.showModal();
});
zoom.addEventListener("click", (event) => {
  if (event.target !== large) zoom.close();
});
zoom.addEventListener("close", () => large.removeAttribute("src"));
