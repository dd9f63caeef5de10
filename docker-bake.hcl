# The image for both architectures: docker buildx bake --push
# TAG is the version; the builder needs the platforms (docs/deployment.md).
variable "TAG" {
  default = "1.0.0"
}

group "default" {
  targets = ["companion"]
}

target "companion" {
  context    = "."
  dockerfile = "Dockerfile"
  platforms  = ["linux/amd64", "linux/arm64"]
  tags       = ["uav-companion-beams:${TAG}", "uav-companion-beams:latest"]
}
