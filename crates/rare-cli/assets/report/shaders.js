// The programs that run on the graphics card. Colours are plain sRGB numbers from end to end: no lighting, no conversion.

/** Points as discs of a size in metres, never smaller than `smallest` pixels, coloured by cloud or through a palette. */
export const pointShader = {
  vertex: `
    attribute vec4 residuals;
    attribute vec4 visibility;
    uniform vec4 chosenPose;
    uniform vec3 cloudColour;
    uniform sampler2D palette;
    uniform int mode;
    uniform float diameter;
    uniform float smallest;
    uniform float pixelsPerUnit;
    varying vec3 colour;

    void main() {
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      gl_PointSize = clamp(diameter * pixelsPerUnit / gl_Position.w, smallest, 48.0);
      if (mode == 0) {
        colour = cloudColour;
      } else {
        float value = dot(mode == 1 ? residuals : visibility, chosenPose);
        colour = texture2D(palette, vec2((value * 255.0 + 0.5) / 256.0, 0.5)).rgb;
      }
    }`,
  fragment: `
    varying vec3 colour;

    void main() {
      vec2 offset = gl_PointCoord - 0.5;
      if (dot(offset, offset) > 0.25) discard;
      gl_FragColor = vec4(colour, 1.0);
    }`,
};

/**
 * Eye-dome lighting (Boucheny 2009): a pixel is darkened by how far its neighbours lie in front of it. It shows the
 * shape of clouds of one colour, and needs neither normals nor lamps.
 */
export const shadeShader = {
  vertex: `
    varying vec2 place;

    void main() {
      place = position.xy * 0.5 + 0.5;
      gl_Position = vec4(position.xy, 0.0, 1.0);
    }`,
  fragment: `
    uniform sampler2D colours;
    uniform sampler2D depths;
    uniform vec2 pixel;
    uniform int samples;
    uniform float reach;
    uniform vec3 background;
    uniform float near;
    uniform float far;
    uniform float strength;
    varying vec2 place;

    float logarithmicDepth(float depth) {
      return log2(near * far / (far - depth * (far - near)));
    }

    float darkening(float here, vec2 at, vec2 offset) {
      float depth = texture2D(depths, at + offset * reach * pixel).r;
      return depth >= 1.0 ? 0.0 : clamp(here - logarithmicDepth(depth), 0.0, 0.03);
    }

    vec3 shaded(vec2 at) {
      float depth = texture2D(depths, at).r;
      if (depth >= 1.0) return background;
      float here = logarithmicDepth(depth);
      float sum = darkening(here, at, vec2(1.0, 0.0)) + darkening(here, at, vec2(-1.0, 0.0))
        + darkening(here, at, vec2(0.0, 1.0)) + darkening(here, at, vec2(0.0, -1.0))
        + darkening(here, at, vec2(1.5, 1.5)) + darkening(here, at, vec2(-1.5, 1.5))
        + darkening(here, at, vec2(1.5, -1.5)) + darkening(here, at, vec2(-1.5, -1.5));
      return texture2D(colours, at).rgb * max(exp(-strength * sum), 0.25);
    }

    void main() {
      vec3 sum = vec3(0.0);
      vec2 first = place - pixel * 0.5 * float(samples - 1);
      for (int row = 0; row < samples; row++) {
        for (int column = 0; column < samples; column++) {
          sum += shaded(first + pixel * vec2(column, row));
        }
      }
      gl_FragColor = vec4(sum / float(samples * samples), 1.0);
    }`,
};

/**
 * Correspondences as strips of constant width on the screen, since cards draw lines only one pixel wide. `position.x` is
 * 0 at the source's end and 1 at the reference's, `position.y` is the side of the strip.
 */
export const lineShader = {
  vertex: `
    attribute vec3 sourceEnd;
    attribute vec3 referenceEnd;
    uniform mat4 referenceFromSource;
    uniform vec2 resolution;
    uniform float width;
    uniform float nearest;
    varying float along;

    vec4 cut(vec4 end, vec4 other) {
      if (end.w >= nearest) return end;
      return mix(end, other, (nearest - end.w) / (other.w - end.w));
    }

    void main() {
      mat4 clipFromReference = projectionMatrix * viewMatrix;
      vec4 first = clipFromReference * referenceFromSource * vec4(sourceEnd, 1.0);
      vec4 second = clipFromReference * vec4(referenceEnd, 1.0);
      if (first.w < nearest && second.w < nearest) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // behind the camera
        return;
      }
      vec4 from = cut(first, second);
      vec4 to = cut(second, first);
      vec2 start = from.xy / from.w * resolution * 0.5;
      vec2 end = to.xy / to.w * resolution * 0.5;
      vec2 direction = normalize(end - start + vec2(1e-4, 0.0));
      vec2 place = mix(start, end, position.x) + vec2(-direction.y, direction.x) * position.y * width * 0.5;
      along = position.x * length(end - start);
      gl_Position = vec4(place / (resolution * 0.5), 0.0, 1.0);
    }`,
  fragment: `
    uniform vec3 lineColour;
    uniform float opacity;
    uniform float dash;
    varying float along;

    void main() {
      if (dash > 0.0 && mod(along, dash) > dash * 0.55) discard;
      gl_FragColor = vec4(lineColour, opacity);
    }`,
};
