{{/* SPDX-License-Identifier: Apache-2.0 */}}

{{/* What the pods of all components share: (dict "root" $ "of" .Values.front "component" "front"). */}}
{{- define "pugeo.pod" -}}
automountServiceAccountToken: false
enableServiceLinks: false
{{- with .root.Values.image.pullSecrets }}
imagePullSecrets:
  {{- toYaml . | nindent 2 }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
{{- with .of.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .of.tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .of.affinity }}
affinity:
  {{- toYaml . | nindent 2 }}
{{- end }}
topologySpreadConstraints:
  - maxSkew: 1
    topologyKey: kubernetes.io/hostname
    whenUnsatisfiable: ScheduleAnyway
    labelSelector:
      matchLabels:
        {{- include "pugeo.selector" . | nindent 8 }}
{{- end }}

{{/* Name, image and rights of a container; all of them have the image's root read-only. */}}
{{- define "pugeo.container" -}}
image: {{ include "pugeo.image" .root | quote }}
imagePullPolicy: {{ .root.Values.image.pullPolicy }}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities: {drop: [ALL]}
{{- end }}

{{/* The kernels of the image, in a folder where those for another processor can be added. Not
"cp -a": only the owner of a folder may set its times, and the node's root owns this one. */}}
{{- define "pugeo.kernels" -}}
- name: kernels
  {{- include "pugeo.container" . | nindent 2 }}
  command: ["cp", "-r", "/var/cache/pugeo/.", "/kernels"]
  resources:
    requests: {cpu: 50m, memory: 32Mi}
    limits: {memory: 128Mi}
  volumeMounts:
    - {name: kernels, mountPath: /kernels}
{{- end }}
