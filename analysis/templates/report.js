// Makes the headings of a table buttons that sort it. Without scripts the table is just a table, best trial first.
const notKnownLast = (a, b) => (a === "") - (b === "");
const byValue = (a, b) => (isNaN(a) || isNaN(b) ? a.localeCompare(b, undefined, { numeric: true }) : a - b);

function sortBy(table, column, rising) {
  const value = (row) => row.cells[column].dataset.value;
  const rows = [...table.tBodies[0].rows];
  rows.sort((one, two) => {
    const a = value(one), b = value(two);
    if (a === "" || b === "") return notKnownLast(a, b);
    return rising ? byValue(a, b) : byValue(b, a);
  });
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll("table.sortable")) {
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      const rising = heading.getAttribute("aria-sort") !== "ascending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", rising ? "ascending" : "descending");
      sortBy(table, column, rising);
    });
  });
  document.getElementById("sorting").textContent = "; press a heading to sort";
}
