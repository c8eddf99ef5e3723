#version 330 core
// A tag from its cells, one texel each, or a part's face of one level.
//
// The edge between two cells is smoothed by a box of |du/dx| + |du/dy| cells. On an edge of slope p : q against the sample
// grid the samples lie 1/sqrt(p^2 + q^2) apart and the box is p + q times as wide: a whole number of steps for every
// rational slope, so that the mean over an edge is right just where plain sampling fails, at 0, 45, 26.6 degrees. Where
// it matters most, within 14 degrees of the grid's axes, a second box makes it right to second order.
out vec4 frag_color;

#ifdef HAS_BASE_COLOR_TEX
struct Material {
    sampler2D base_color_texture;
};
uniform Material material;
in vec2 place;

// The integral to t of a box of width `wide` convolved with one of width `more`, `more` at most `wide`.
vec2 smoothed(vec2 t, vec2 wide, vec2 more)
{
    vec2 size = abs(t);
    vec2 rest = max(0.5 * (wide + more) - size, 0.0);
    vec2 tail = 0.5 * rest * rest / (wide * more);
    vec2 below = mix(tail, 0.5 - size / wide, lessThanEqual(size, 0.5 * (wide - more)));
    return mix(below, 1.0 - below, greaterThan(t, vec2(0.0)));
}

float cell(ivec2 at, ivec2 last)
{
    return texelFetch(material.base_color_texture, clamp(at, ivec2(0), last), 0).r;
}

void main()
{
    ivec2 size = textureSize(material.base_color_texture, 0);
    vec2 at = place * vec2(size) - 0.5;
    vec2 across = abs(dFdx(at)), down = abs(dFdy(at));
    vec2 wide = clamp(across + down, 1e-6, 0.5);
    vec2 more = clamp(max(across, down) - 4.0 * min(across, down), 1e-3 * wide, wide);
    vec2 share = smoothed(fract(at) - 0.5, wide, more);
    ivec2 low = ivec2(floor(at));
    float near = mix(cell(low, size - 1), cell(low + ivec2(1, 0), size - 1), share.x);
    float far = mix(cell(low + ivec2(0, 1), size - 1), cell(low + ivec2(1, 1), size - 1), share.x);
    frag_color = vec4(vec3(mix(near, far, share.y)), 1.0);
}
#else
in vec4 shade;

void main()
{
    frag_color = shade;
}
#endif
