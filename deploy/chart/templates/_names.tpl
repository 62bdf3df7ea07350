{{/* SPDX-License-Identifier: Apache-2.0 */}}

{{/* Name of a component: the release, or the release and the chart where it does not name it. */}}
{{- define "pugeo.fullname" -}}
{{- $base := ternary .Release.Name (printf "%s-%s" .Release.Name .Chart.Name) (contains .Chart.Name .Release.Name) -}}
{{- $base | trunc 50 | trimSuffix "-" -}}
{{- end }}

{{/* Labels that select the pods of a component: (dict "root" $ "component" "front"). */}}
{{- define "pugeo.selector" -}}
app.kubernetes.io/name: {{ .root.Chart.Name }}
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end }}

{{- define "pugeo.labels" -}}
{{ include "pugeo.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end }}

{{- define "pugeo.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "pugeo.tlsSecret" -}}
{{ .Values.tls.existingSecret | default (printf "%s-tls" (include "pugeo.fullname" .)) }}
{{- end }}

{{- define "pugeo.keysSecret" -}}
{{- if .Values.keys.existingSecret -}}
{{ .Values.keys.existingSecret }}
{{- else if .Values.keys.entries -}}
{{ include "pugeo.fullname" . }}-keys
{{- end -}}
{{- end }}
