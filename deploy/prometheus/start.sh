#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Starts Prometheus with prometheus.yml, which has no variables of its own, and where
# PUGEO_REMOTE_WRITE_URL is set, with the address to which metrics are sent on.
set -eu
source=$(dirname "$0")
data=${PROMETHEUS_DATA:-/prometheus}

quoted() {
  printf "'%s'" "$(printf %s "$1" | sed "s/'/''/g")"
}

umask 077 # the configuration may hold a password
sed "s|alerts.yml|$source/alerts.yml|" "$source/prometheus.yml" > "$data/prometheus.yml"
if [ -n "${PUGEO_REMOTE_WRITE_URL:-}" ]; then
  {
    echo "remote_write:"
    echo "  - url: $(quoted "$PUGEO_REMOTE_WRITE_URL")"
    if [ -n "${PUGEO_REMOTE_WRITE_USER:-}" ]; then
      echo "    basic_auth:"
      echo "      username: $(quoted "$PUGEO_REMOTE_WRITE_USER")"
      echo "      password: $(quoted "${PUGEO_REMOTE_WRITE_PASSWORD:-}")"
    fi
  } >> "$data/prometheus.yml"
fi
exec prometheus --config.file="$data/prometheus.yml" --storage.tsdb.path="$data" "$@"
