#!/bin/sh
# An arm64 Python with this project's locked packages, to run under qemu-user on another machine:
#
#     tests/arm/make_root.sh          Debian only; as root, as it adds the architecture to apt
#     build/arm/python -c "import platform; print(platform.machine())"
#
# Packages come from apt's own sources, wheels from pip's, held against requirements.lock.
set -eu
cd "$(dirname "$0")/../.."
into=$PWD/build/arm
packages="python3.11-minimal libpython3.11-minimal libpython3.11-stdlib libc6 libexpat1 zlib1g
    libssl3 libbz2-1.0 libffi8 liblzma5 libsqlite3-0 libuuid1 libncursesw6 libtinfo6 libreadline8
    libgcc-s1 libstdc++6 libcrypt1 libgomp1"

apt-get install -y -q qemu-user gcc libc6-dev >/dev/null
dpkg --add-architecture arm64
apt-get update -q >/dev/null
rm -rf "$into"
mkdir -p "$into/debs" "$into/root" "$into/wheels" "$into/site"
(
    cd "$into/debs"
    for package in $packages; do apt-get download -q "$package:arm64" >/dev/null; done
    for deb in *.deb; do dpkg -x "$deb" ../root; done
)
platforms=""
for glibc in 2014 _2_17 _2_27 _2_28 _2_34; do
    platforms="$platforms --platform manylinux${glibc}_aarch64"
done
# shellcheck disable=SC2086  # several words
.venv/bin/python -m pip --disable-pip-version-check download -q --require-hashes --no-deps \
    --only-binary=:all: $platforms --python-version 3.11 --implementation cp \
    --abi cp311 --abi abi3 --abi none -d "$into/wheels" -r requirements.lock
for wheel in "$into"/wheels/*.whl; do .venv/bin/python -m zipfile -e "$wheel" "$into/site"; done
cc -shared -fPIC -O2 -Wall -o "$into/count_instructions.so" tests/arm/count_instructions.c
cat >"$into/python" <<END
#!/bin/sh
# The arm64 interpreter; QEMU_PLUGIN names a plugin.
exec qemu-aarch64 \${QEMU_PLUGIN:+-plugin "\$QEMU_PLUGIN"} -L "$into/root" \\
    -E PYTHONHOME="$into/root/usr" -E PYTHONPATH="$PWD:$PWD/tests:$into/site" \\
    -E OPENBLAS_NUM_THREADS=1 -E PYTHONDONTWRITEBYTECODE=1 \\
    "$into/root/usr/bin/python3.11" "\$@"
END
chmod +x "$into/python"
