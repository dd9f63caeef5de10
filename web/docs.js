// The API's document, drawn by Swagger UI. Requests that are tried on it bring the tab's token.

import { tokenOfTab } from "./token.js";

SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  displayRequestDuration: true,
  docExpansion: "list",
  defaultModelsExpandDepth: 0,
  validatorUrl: null, // nothing is asked of anybody else
  requestInterceptor: (request) => {
    const token = tokenOfTab();
    if (token && !request.headers.Authorization) request.headers.Authorization = `Bearer ${token}`;
    return request;
  },
});
