#!/bin/sh
# Test certificates: a certificate authority, and one certificate per name.
#
#     sh make_certificates.sh DIR NAME...
#
# makes DIR/ca.pem, DIR/NAME.pem and DIR/NAME.key. NAME is the name of a node, the common name of
# its certificate, as used in access-control.json5. ADDRESSES are the addresses that the certificate
# is valid for, in the syntax of openssl. In the field, do not store ca.key on any node.
set -eu
DIR=$1
shift
ADDRESSES=${ADDRESSES:-DNS:localhost,IP:127.0.0.1}
DAYS=${DAYS:-30}
KEY="-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes"
umask 077
mkdir -p "$DIR"
cd "$DIR"
if [ ! -f ca.key ]; then
    # shellcheck disable=SC2086
    openssl req -x509 $KEY -days "$DAYS" -subj "/CN=fleet authority" \
        -addext basicConstraints=critical,CA:TRUE -addext keyUsage=critical,keyCertSign \
        -keyout ca.key -out ca.pem 2>/dev/null
fi
for NAME in "$@"; do
    printf 'subjectAltName=%s\nextendedKeyUsage=serverAuth,clientAuth\n' "$ADDRESSES" >"$NAME.ext"
    # shellcheck disable=SC2086
    openssl req $KEY -subj "/CN=$NAME" -keyout "$NAME.key" -out "$NAME.csr" 2>/dev/null
    openssl x509 -req -in "$NAME.csr" -CA ca.pem -CAkey ca.key -CAcreateserial -days "$DAYS" \
        -extfile "$NAME.ext" -out "$NAME.pem" 2>/dev/null
    rm "$NAME.csr" "$NAME.ext"
done
