// For node's loader: the page's .js files are modules, as <script type="module"> says there.

export async function resolve(specifier, context, next) {
  const found = await next(specifier, context);
  return /\.js(\?|$)/.test(found.url) ? { ...found, format: "module" } : found;
}
