// A click on a picture shows it at its full size; any further click, or Escape, closes it.
const large = document.getElementById("large");
for (const button of document.querySelectorAll("button.enlarge")) {
  button.addEventListener("click", () => {
    large.replaceChildren(button.querySelector("img").cloneNode());
    large.showModal();
  });
}
large.addEventListener("click", () => large.close());
