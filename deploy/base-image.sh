#!/usr/bin/env bash
# Makes the base image of deploy/Dockerfile where no registry of images can be reached: Debian bookworm with its Python
# 3.11, from this machine's own Debian mirror, trusting the certificate authorities that this machine trusts.
# Say SAFEDPA_BASE_IMAGE=safedpa-base:bookworm for the build then. Elsewhere no one needs it: docker pulls the image that
# deploy/Dockerfile names. Needs root, debootstrap and docker.
set -euo pipefail
name=${1:-safedpa-base:bookworm}
if docker image inspect "$name" > /dev/null 2>&1; then
    echo "$name is there already"
    exit 0
fi
mirror=$(cat /etc/apt/sources.list /etc/apt/sources.list.d/*.{list,sources} 2> /dev/null \
    | sed -nE 's/^(URIs:|deb( \[[^]]*\])?) +(https?:[^ ]+\/debian)\/?( .*)?$/\3/p' | sed -n 1p || true)
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
debootstrap --variant=minbase --include=ca-certificates bookworm "$folder" ${mirror:+"$mirror"}
chroot "$folder" apt-get -q update
DEBIAN_FRONTEND=noninteractive chroot "$folder" apt-get -q install -y --no-install-recommends python3.11 python3.11-venv
ln -s python3.11 "$folder/usr/bin/python"
cp /etc/ssl/certs/ca-certificates.crt "$folder/etc/ssl/certs/ca-certificates.crt"
rm -rf "$folder"/var/cache/apt/* "$folder"/var/lib/apt/lists/* "$folder"/usr/share/{doc,man,locale}/*
tar --create --directory "$folder" --numeric-owner . | docker import --change 'CMD ["python"]' - "$name"
