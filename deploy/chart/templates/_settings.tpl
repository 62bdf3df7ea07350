{{/* SPDX-License-Identifier: Apache-2.0 */}}

{{/* Ends with a message if a name in `settings` or `secretSettings` is one that chart or image set. */}}
{{- define "pugeo.checkSettings" -}}
{{- $keys := "name keys.existingSecret, or use keys.entries" }}
{{- $certificates := "name tls.existingSecret" }}
{{- $set := dict
  "PUGEO_API_KEYS" $keys
  "PUGEO_API_KEYS_FILE" $keys
  "PUGEO_DATABASE_URL" "name database.existingSecret"
  "PUGEO_DRAIN_DELAY_S" "use front.drainDelaySeconds"
  "PUGEO_DRAIN_S" "use front.drainSeconds"
  "PUGEO_ENGINE" "workers are pods of their own"
  "PUGEO_HOST" "fronts listen on all addresses of their pods"
  "PUGEO_JOBS_DIR" "use jobs.persistence"
  "PUGEO_METRICS_PORT" "it is 9100"
  "PUGEO_MODEL" "use model"
  "PUGEO_MODELS_DIR" "use models.existingClaim"
  "PUGEO_PORT" "use service.port"
  "PUGEO_SCHEDULER" "the scheduler is a pod of this release"
  "PUGEO_SPOOL_DIR" "use front.spoolSize"
  "PUGEO_TLS_CA" $certificates
  "PUGEO_TLS_CERT" $certificates
  "PUGEO_TLS_KEY" $certificates
  "PUGEO_WORKERS" "use worker.replicas, or autoscaling"
  "PUGEO_WORKER_MEMORY" "use worker.resources"
}}
{{- range $where := list "settings" "secretSettings" }}
{{- range $name, $_ := index $.Values $where }}
{{- with get $set $name }}
{{- fail (printf "%s.%s cannot be set, since the chart does; %s" $where $name .) }}
{{- end }}
{{- end }}
{{- end }}
{{- if hasKey .Values.settings "PUGEO_WEBHOOK_SECRET" }}
{{- fail "settings.PUGEO_WEBHOOK_SECRET is a secret; use secretSettings" }}
{{- end }}
{{- end }}
