# The service in a container, for amd64 and arm64: as an unprivileged user, on a root file system
# that may be read only, with nothing in it but what it runs. docs/deployment.md
ARG BASE=python:3.11-slim-bookworm
# The same Python with more beside it, of which `strip` is used.
ARG BUILD=python:3.11-bookworm

FROM ${BUILD} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/venv
WORKDIR /src
# The packages first: they change seldom, so this layer is made seldom. Wheels alone: a package
# without a wheel for this machine is to fail at once.
COPY requirements.lock ./
RUN /opt/venv/bin/pip install --require-hashes --only-binary :all: -r requirements.lock
COPY . ./
# What only builds is taken away again, pip last.
RUN /opt/venv/bin/pip install --no-deps --no-build-isolation . \
    && /opt/venv/bin/pip uninstall --yes editables hatchling pathspec pluggy trove-classifiers \
    && /opt/venv/bin/pip check
# What packages ask for and nothing here uses: solvers beside Clarabel, what generates MAVLink; then
# their own tests, dialects that nobody speaks here, and symbols for debuggers. It is over half of
# all. Not of packages that bring libraries: what was patched to find these need not load once
# stripped.
RUN /opt/venv/bin/pip uninstall --yes highspy lxml scs setuptools sparsediffpy pip \
    && find /opt/venv/lib -type d -name tests -prune -exec rm -r {} + \
    && find /opt/venv/lib -path '*/pymavlink/dialects/v*' -type f \
        ! -path '*/v20/*__init__*' ! -path '*/v20/*all.*' ! -path '*/v20/*ardupilotmega.*' -delete \
    && find /opt/venv/lib -name '*.so' ! -path '*.libs/*' ! -path '*/numpy/*' ! -path '*/scipy/*' \
        ! -path '*/PIL/*' -exec strip --strip-unneeded {} +

FROM ${BASE}
COPY --from=build /opt/venv /opt/venv
RUN install -d -o 10001 -g 10001 /recordings && install -d /config
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    OPENBLAS_NUM_THREADS=1
# A numeric id, so that an orchestrator can see that it is not root without reading /etc/passwd.
USER 10001:10001
WORKDIR /tmp
VOLUME /recordings
EXPOSE 8080/tcp 14550/udp
# Fit to be used, not merely alive: unhealthy without a carrier or while beam updates are late.
HEALTHCHECK --interval=10s --timeout=5s --start-period=15s --retries=3 \
    CMD ["python", "-c", "import os; from urllib.request import Request, urlopen; urlopen(Request('http://127.0.0.1:8080/readyz', headers={'Authorization': 'Bearer ' + os.environ.get('COMPANION_TOKEN', '')}), timeout=4)"]
ENTRYPOINT ["companion"]
# In a container the service must listen on every address to be reached at all, hence
# --insecure: publish the port on 127.0.0.1, as docker-compose.yml does, or set a token instead.
CMD ["run", "--link", "udpin:0.0.0.0:14550", "--center", "5:1", "--listen", "0.0.0.0:8080", "--insecure", "--record", "/recordings"]
