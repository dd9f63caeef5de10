// The API's document in Swagger UI. Requests from it use the tab's token.

import { tokenOfTab } from "./token.js";

SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#docs",
  deepLinking: true,
  displayRequestDuration: true,
  docExpansion: "list",
  defaultModelsExpandDepth: 0,
  validatorUrl: null, // no request to another server
  requestInterceptor: (request) => {
    const token = tokenOfTab();
    if (token && !request.headers.Authorization) request.headers.Authorization = `Bearer ${token}`;
    return request;
  },
});
