# The images for amd64 and arm64: docker buildx bake --push (docs/deployment.md says how).
variable "TAG" {
  default = "1.0.0"
}

# Where images are pushed, with a slash at the end.
variable "REGISTRY" {
  default = ""
}

group "default" {
  targets = ["companion"]
}

target "companion" {
  context    = "."
  dockerfile = "Dockerfile"
  platforms  = ["linux/amd64", "linux/arm64"]
  tags       = ["${REGISTRY}uav-companion-beams:${TAG}", "${REGISTRY}uav-companion-beams:latest"]
}

# The BlueOS extension, on the image above of the same architecture.
target "blueos" {
  context    = "examples/blueos"
  dockerfile = "Dockerfile"
  contexts   = { companion = "target:companion" }
  args       = { IMAGE = "companion", VERSION = "${TAG}" }
  platforms  = ["linux/amd64", "linux/arm64"]
  tags       = ["${REGISTRY}companion-blueos:${TAG}"]
}
