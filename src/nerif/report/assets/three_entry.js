// What volume3d.js takes from three.js; see README.md.
export {
  BackSide, BoxGeometry, BufferGeometry, CanvasTexture, Data3DTexture, DataTexture,
  DataUtils, Float32BufferAttribute, GLSL3, Group, HalfFloatType, LineBasicMaterial,
  LineDashedMaterial, LineSegments, LinearFilter, Matrix4, Mesh, PerspectiveCamera,
  RGBAFormat, RedFormat, SRGBColorSpace, Scene, ShaderMaterial, Sprite,
  SpriteMaterial, UnsignedByteType, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
