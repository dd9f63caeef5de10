# The service in a container, for amd64 and arm64. It runs as an unprivileged user on a root file
# system that may be read-only. See docs/deployment.md.
#
# The digests are those of multi-platform indexes; the tags are for readers. The digest of the full
# image is that of the publisher's record of 19 September 2026; that of the slim one was its tag's from
# 21 September to 1 October. Each was found for its tag in three unrelated public repositories at
# least. docs/deployment.md says how to verify and renew them.
ARG BASE=python:3.11.16-slim-bookworm@sha256:a36c24f9cbdf4fd0f52d67f0823eeac19c2028c637cecc392d97f980d4fec56b
# The full image of the same Python; only `strip` is used of its additions.
ARG BUILD=python:3.11.16-bookworm@sha256:b99029c95d3d37fb1e4e76d287f7984373dca77c665885986e31b2c95260c13c

FROM ${BUILD} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python -m venv /opt/venv
WORKDIR /src
# Packages first: they change rarely, so this layer is cached. Wheels only: a package without a
# wheel for this machine fails at once.
COPY requirements.lock ./
RUN /opt/venv/bin/pip install --require-hashes --only-binary :all: -r requirements.lock
COPY . ./
# Remove the build tools, pip last.
RUN /opt/venv/bin/pip install --no-deps --no-build-isolation . \
    && /opt/venv/bin/pip uninstall --yes editables hatchling pathspec pluggy trove-classifiers \
    && /opt/venv/bin/pip check
# Remove what is not used: solvers other than Clarabel, the MAVLink generator, the packages' tests,
# unused dialects and debug symbols. This is more than half of the size. Wheels that bundle shared
# libraries are not stripped, because their patched modules may not load afterwards.
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
# A numeric id: an orchestrator can check that it is not root without reading /etc/passwd.
USER 10001:10001
WORKDIR /tmp
VOLUME /recordings
EXPOSE 8080/tcp 14550/udp
# Readiness, not liveness: unhealthy without a carrier, or while beam updates are late.
HEALTHCHECK --interval=10s --timeout=5s --start-period=15s --retries=3 \
    CMD ["python", "-c", "import os; from urllib.request import ProxyHandler, Request, build_opener; build_opener(ProxyHandler({})).open(Request('http://127.0.0.1:8080/readyz', headers={'Authorization': 'Bearer ' + os.environ.get('COMPANION_TOKEN', '').strip()}), timeout=4)"]
ENTRYPOINT ["companion"]
# In a container the service must listen on every address, hence --insecure. Publish the port on
# 127.0.0.1, as docker-compose.yml does, or set a token instead.
CMD ["run", "--link", "udpin:0.0.0.0:14550", "--center", "5:1", "--listen", "0.0.0.0:8080", "--insecure", "--record", "/recordings"]
