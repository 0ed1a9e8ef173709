/* SPDX-License-Identifier: MIT-0
   light.h - lighting of a rendered picture: Lambert and Blinn-Phong with any number of lights, shadows and ambient
   occlusion by tracing the same field again. Over plain planes: what was rendered once is lit anew without the net,
   unless shadows are wanted. Include common.h first. */
#ifndef DIST_EXAMPLES_LIGHT_H
#define DIST_EXAMPLES_LIGHT_H

enum { LIGHTS = 16, LIGHT_CHUNK = 16384 };

/* toward: where the light comes from, as seen from the camera: right, up, back to the viewer. */
typedef struct light {
    float toward[3], color[3];
} light;

typedef struct lighting {
    light lights[LIGHTS];
    int count;
    int shadow;    /* 1: what stands between a point and a light takes the light away */
    int occlusion; /* rays a point into the half space over it; the share that meets something takes ambient light */
    float ambient; /* light from everywhere */
    float shine;   /* strength of highlights, of exponent 40 */
} lighting;

/* One key light over the left shoulder, a weaker and bluer one from the right. */
static inline lighting lighting_default(void)
{
    static const light lights[2] = {{{-0.55f, 0.75f, 0.65f}, {0.78f, 0.75f, 0.70f}},
                                    {{0.90f, 0.10f, 0.45f}, {0.16f, 0.18f, 0.24f}}};
    lighting l;
    memset(&l, 0, sizeof l);
    memcpy(l.lights, lights, sizeof lights);
    l.ambient = 0.30f;
    return l;
}

/* What a picture's hits are, gathered: n points with unit normals, in the world. */
typedef struct lit {
    size_t n;
    int *pixel;
    float *point, *normal, *light; /* (n, 3); light starts as 0 and is what falls on the point */
    float radius;                  /* of the field's bounding sphere */
} lit;

static inline lit lit_begin(const dist_field *field, const dist_camera *camera, const dist_images *out)
{
    lit l;
    int pixels = camera->width * camera->height;
    memset(&l, 0, sizeof l);
    for (int i = 0; i < pixels; i++) {
        l.n += out->mask[i] != 0;
    }
    l.pixel = (int *)take(l.n, sizeof *l.pixel);
    l.point = take_floats(9 * l.n);
    l.normal = l.point + 3 * l.n;
    l.light = l.normal + 3 * l.n;
    l.radius = field->radius;
    size_t k = 0;
    for (int i = 0; i < pixels; i++) {
        float o[3], v[3], start = camera->pixel_center;
        if (!out->mask[i]) { continue; }
        dist_camera_ray(camera, start + (float)(i % camera->width), start + (float)(i / camera->width), o, v);
        for (size_t j = 0; j < 3; j++) {
            l.point[3 * k + j] = o[j] + out->distance[i] * v[j];
            for (size_t row = 0; row < 3; row++) /* normals come in camera space */
                l.normal[3 * k + j] += camera->rotation[3 * row + j] * out->normal[3 * (size_t)i + row];
        }
        l.pixel[k++] = i;
    }
    return l;
}

static inline void lit_end(lit *l)
{
    free(l->pixel);
    free(l->point);
}

/* blocked[i]: the ray from a little above point i along direction i meets the field within reach (0: anywhere). */
static inline void lit_trace(dist_context *ctx, const dist_field *field, const lit *l, size_t n, const size_t *which,
                             const float *directions, float reach, unsigned char *blocked)
{
    float *origins = take_floats(3 * n);
    dist_render_desc any;
    memset(&any, 0, sizeof any);
    any.any_hit = 1;
    any.max_distance = reach;
    dist_hit *hits = (dist_hit *)take(n, sizeof *hits);
    for (size_t i = 0; i < 3 * n; i++) {
        size_t k = 3 * which[i / 3] + i % 3;
        origins[i] = l->point[k] + 4e-3f * l->radius * l->normal[k];
    }
    dist_trace(ctx, field, n, origins, directions, &any, hits, NULL);
    check(ctx);
    for (size_t i = 0; i < n; i++) {
        blocked[i] = hits[i].status == DIST_RAY_INSIDE || hits[i].status == DIST_RAY_HIT;
    }
    free(origins);
    free(hits);
}

/* Adds what one light gives: color max(0, n . l) and a highlight, where nothing stands between. toward: world, unit. */
static inline void lit_add(dist_context *ctx, const dist_field *field, const lit *l, const lighting *how,
                           const float toward[3], const float color[3], const float eye[3], float *highlight)
{
    size_t *which = (size_t *)take(l->n, sizeof *which);
    unsigned char *blocked = (unsigned char *)take(l->n, 1);
    float *directions = take_floats(3 * l->n);
    size_t facing = 0;
    for (size_t k = 0; k < l->n; k++) {
        const float *n = l->normal + 3 * k;
        if (n[0] * toward[0] + n[1] * toward[1] + n[2] * toward[2] <= 0.0f) { continue; }
        memcpy(directions + 3 * facing, toward, 3 * sizeof(float));
        which[facing++] = k;
    }
    if (how->shadow) { lit_trace(ctx, field, l, facing, which, directions, 0.0f, blocked); }
    for (size_t i = 0; i < facing; i++) {
        const float *n = l->normal + 3 * which[i];
        const float *p = l->point + 3 * which[i];
        float half[3], length = 0.0f, away = 0.0f, along = 0.0f;
        if (blocked[i]) { continue; }
        float lambert = n[0] * toward[0] + n[1] * toward[1] + n[2] * toward[2];
        for (int j = 0; j < 3; j++) away += (eye[j] - p[j]) * (eye[j] - p[j]);
        for (int j = 0; j < 3; j++) {
            half[j] = toward[j] + (eye[j] - p[j]) / sqrtf(away);
            length += half[j] * half[j];
            along += half[j] * n[j];
        }
        float shine = along > 0.0f && length > 0.0f ? how->shine * powf(along / sqrtf(length), 40.0f) : 0.0f;
        for (size_t j = 0; j < 3; j++) {
            l->light[3 * which[i] + j] += color[j] * lambert;
            highlight[3 * which[i] + j] += color[j] * shine;
        }
    }
    free(which);
    free(blocked);
    free(directions);
}

/* Ambient light: the share of `rays` directions, spread about the normal by the cosine, that meet nothing within half
   the bounding radius. The directions are a golden-ratio spiral, turned from point to point. */
static inline void lit_add_ambient(dist_context *ctx, const dist_field *field, const lit *l, const lighting *how)
{
    size_t rays = (size_t)how->occlusion, chunk = rays > 0 ? LIGHT_CHUNK / rays + 1 : l->n + 1;
    size_t *which = (size_t *)take(chunk * rays, sizeof *which);
    unsigned char *blocked = (unsigned char *)take(chunk * rays, 1);
    float *directions = take_floats(3 * chunk * rays);
    progress shown = progress_begin("ambient occlusion");
    for (size_t first = 0; first < l->n; first += chunk) {
        size_t count = l->n - first < chunk ? l->n - first : chunk;
        for (size_t i = 0; i < count * rays; i++) {
            size_t k = first + i / rays, r = i % rays;
            const float *n = l->normal + 3 * k;
            int pixel = l->pixel[k];
            float turn = 52.9829189f * (0.06711056f * (float)(pixel % 4096) + 0.00583715f * (float)(pixel / 4096));
            float angle = 2.39996323f * (float)r + 2.0f * PI * (turn - floorf(turn));
            float square = ((float)r + 0.5f) / (float)rays, x = sqrtf(square) * cosf(angle);
            float y = sqrtf(square) * sinf(angle), z = sqrtf(1.0f - square);
            /* a frame around n without a square root (Duff et al. 2017) */
            float sign = n[2] < 0.0f ? -1.0f : 1.0f, a = -1.0f / (sign + n[2]), b = n[0] * n[1] * a;
            float *d = directions + 3 * i;
            d[0] = x * (1.0f + sign * n[0] * n[0] * a) + y * b + z * n[0];
            d[1] = x * sign * b + y * (sign + n[1] * n[1] * a) + z * n[1];
            d[2] = -x * sign * n[0] - y * n[1] + z * n[2];
            which[i] = k;
        }
        if (rays > 0) { lit_trace(ctx, field, l, count * rays, which, directions, 0.5f * l->radius, blocked); }
        for (size_t k = first; k < first + count; k++) {
            size_t open = rays;
            for (size_t r = 0; r < rays; r++) open -= blocked[(k - first) * rays + r];
            float share = rays > 0 ? (float)open / (float)rays : 1.0f;
            for (size_t j = 0; j < 3; j++) l->light[3 * k + j] += how->ambient * share;
        }
        progress_show(&shown, (double)first, (double)l->n, NULL, 0);
    }
    progress_end(&shown);
    free(which);
    free(blocked);
    free(directions);
}

/* A picture under lights, from planes mask, distance, normal (camera space) and, if there is one, color. */
static inline canvas picture_lit(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                 const dist_images *out, const lighting *how)
{
    canvas c = canvas_create(camera->width, camera->height, 0.0f);
    lit l = lit_begin(field, camera, out);
    float *highlight = take_floats(3 * l.n), eye[3], ahead[3];
    paint_background(&c);
    dist_camera_ray(camera, 0.0f, 0.0f, eye, ahead);
    dist_cache *cache = how->occlusion > 0 ? dist_cache_create(ctx, field, 0) : NULL; /* so many rays pay for it */
    dist_field cached = dist_cache_field(cache);
    if (cache) { field = &cached; }
    lit_add_ambient(ctx, field, &l, how);
    for (int i = 0; i < how->count; i++) {
        const float *t = how->lights[i].toward;
        float toward[3], length = sqrtf(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]);
        for (int j = 0; j < 3; j++) {
            toward[j] = (camera->rotation[j] * t[0] - camera->rotation[3 + j] * t[1] - camera->rotation[6 + j] * t[2]) /
                        length;
        }
        lit_add(ctx, field, &l, how, toward, how->lights[i].color, eye, highlight);
    }
    for (size_t k = 0; k < l.n; k++) {
        static const float clay[3] = {0.90f, 0.84f, 0.77f};
        const float *albedo = out->color ? out->color + 3 * l.pixel[k] : clay;
        const float *falls = l.light + 3 * k, *shine = highlight + 3 * k;
        canvas_set(&c, l.pixel[k] % camera->width, l.pixel[k] / camera->width, falls[0] * albedo[0] + shine[0],
                   falls[1] * albedo[1] + shine[1], falls[2] * albedo[2] + shine[2]);
    }
    dist_cache_destroy(cache);
    free(highlight);
    lit_end(&l);
    return c;
}

#endif
