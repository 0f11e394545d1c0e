// The other versions of this site: tools/site_versions.py puts them in folders beside this one, with their list. Where there
// is none, as on your own disk, the box stays hidden. A page that the other version lacks leads to its first page.
document.addEventListener("DOMContentLoaded", async () => {
  const label = document.querySelector(".sidebar-versions");
  if (!label || !location.protocol.startsWith("http")) return;
  const root = new URL(document.documentElement.dataset.content_root || "./", location.href);
  const list = await fetch(new URL("../versions.json", root)).catch(() => null);
  if (!list || !list.ok) return;
  const here = root.pathname.split("/").at(-2);
  const select = label.querySelector("select");
  for (const name of await list.json()) select.add(new Option(name, name, name === here, name === here));
  label.hidden = false;
  select.addEventListener("change", async () => {
    const page = location.href.slice(root.href.length);
    const other = new URL(`../${select.value}/`, root);
    const answer = await fetch(new URL(page.split("#")[0], other), { method: "HEAD" }).catch(() => null);
    location.href = answer && answer.ok ? new URL(page, other) : other;
  });
});
