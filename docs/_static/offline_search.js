// A page that was opened from a folder may not read the others for excerpts: their texts come from
// a script instead (docs/_ext/excerpts.py).
if (location.protocol === "file:" && location.pathname.endsWith("/search.html")) {
  const root = location.href.replace(/search\.html.*$/, "");
  const texts = new Promise((known) => {
    const script = document.createElement("script");
    script.src = `${root}_static/page_texts.js`;
    script.onload = () => known(window.PAGE_TEXTS);
    script.onerror = () => known({});
    document.head.append(script);
  });
  const elsewhere = window.fetch;
  window.fetch = async (address, ...rest) => {
    const url = new URL(address, location.href).href;
    if (!url.startsWith(root)) return elsewhere(address, ...rest);
    const name = decodeURIComponent(url.slice(root.length)).replace(/[#?].*$/, "");
    return new Response((await texts)[name] ?? "");
  };
}
