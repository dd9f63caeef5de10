# The service in a container: as an unprivileged user, and nothing in it but what it runs.
ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/venv
WORKDIR /src
# The packages first: they change seldom, so this layer is made seldom.
COPY requirements.lock ./
RUN /opt/venv/bin/pip install --require-hashes -r requirements.lock
COPY . ./
RUN /opt/venv/bin/pip install --no-deps --no-build-isolation .

FROM ${BASE}
COPY --from=build /opt/venv /opt/venv
# A numeric id, so that an orchestrator can see that it is not root without reading /etc/passwd.
RUN install -d -o 10001 -g 10001 /recordings && install -d /config
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    OPENBLAS_NUM_THREADS=1
USER 10001:10001
WORKDIR /tmp
VOLUME /recordings
EXPOSE 8080/tcp 14550/udp
HEALTHCHECK --interval=10s --timeout=5s --start-period=15s --retries=3 \
    CMD ["python", "-c", "from urllib.request import urlopen; urlopen('http://127.0.0.1:8080/readyz', timeout=4)"]
ENTRYPOINT ["companion"]
# In a container the service must listen on every address to be reached at all, hence
# --insecure: publish the port on 127.0.0.1, as docker-compose.yml does, or set a token instead.
CMD ["run", "--link", "udpin:0.0.0.0:14550", "--center", "5:1", "--listen", "0.0.0.0:8080", "--insecure", "--record", "/recordings"]
