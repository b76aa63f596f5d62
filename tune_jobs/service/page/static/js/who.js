// Who looks at the page, as the service says; `main.js` fills it in.
export const me = { name: "local", role: "viewer", version: "", num_cpus: null, address: null };

export const maySubmit = () => me.role !== "viewer";
export const mayChange = (sweep) => me.role === "admin" || (me.role === "submitter" && sweep.owner === me.name);
