// From the disk, browsers refuse workers and fetched files: load the index as a script, and search in this thread.
if (location.protocol === "file:") {
  const load = (name) =>
    new Promise((resolve, reject) => {
      const script = document.createElement("script");
      Object.assign(script, { src: `${base_url}/search/${name}`, onload: resolve, onerror: reject });
      document.head.append(script);
    });
  window.Worker = class {
    async postMessage(message) {
      if (message.init) {
        await load("lunr.js");
        await load("search_index.js");
        this.documents = Object.fromEntries(searchIndex.docs.map((page) => [page.location, page]));
        this.index = lunr(function () {
          this.field("title");
          this.field("text");
          this.ref("location");
          searchIndex.docs.forEach((page) => this.add(page));
        });
        this.onmessage({ data: { config: searchIndex.config } });
        this.onmessage({ data: { allowSearch: true } });
      } else {
        const pages = this.index.search(message.query).map((found) => this.documents[found.ref]);
        this.onmessage({ data: { results: pages.map((page) => ({ ...page, summary: page.text.slice(0, 200) })) } });
      }
    }
  };
}
