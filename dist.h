/* SPDX-License-Identifier: MIT-0
   dist.h - differentiable sphere tracing of neural signed distance functions

   What it is: a trained decoder f(p, z) -> signed distance goes in; depth, normals, silhouette and mask from any camera
   come out; and a loss on those images goes back, by a hand-derived adjoint, to the code z, the camera and the weights.
   The method is Liu et al., "DIST: Rendering Deep Implicit Signed Distance Function with Differentiable Sphere
   Tracing", CVPR 2020; "the paper" below. One file, C99 and C++11, no dependency, no build flag.

   What it does not: no GPU, no window, no general automatic differentiation, no path tracing; no 16-bit images.

   How to use it:
       #define DIST_IMPLEMENTATION                                            // in one file of your program
       #include "dist.h"                                 // W, H and depth (W * H floats) below are yours

       dist_context *ctx    = dist_context_create(NULL);
       dist_net     *net    = dist_net_load_file(ctx, "model.safetensors");
       dist_shape   *shape  = dist_shape_create(ctx, net, dist_net_code(net, 0));
       dist_field    field  = dist_shape_field(shape);
       float eye[3] = {1.4f, 1.0f, 2.0f}, at[3] = {0, 0, 0}, up[3] = {0, 1, 0};
       dist_camera   camera = dist_camera_look_at(W, H, 0.7f, eye, at, up);
       dist_images   out; memset(&out, 0, sizeof out); out.depth = depth;     // what is NULL is not computed
       dist_render(ctx, &field, &camera, NULL, &out, NULL);
       if (dist_context_status(ctx) != DIST_OK) puts(dist_context_message(ctx));   // one check at the end is enough
       dist_shape_destroy(shape), dist_net_destroy(net), dist_context_destroy(ctx); // the context last
   Built with "cc -O2 app.c -lm"; with -fopenmp (MSVC: /openmp) it uses all cores.

   Options, defined before the include:
       DIST_IMPLEMENTATION    the functions themselves, in one file
       DIST_STATIC            all functions static;  DIST_API  your own linkage
       DIST_ASSERT(x)         default assert-like no-op; our own mistakes only, never yours
       DIST_NO_SIMD           portable C only
       DIST_NO_OPENMP         ignore the compiler's OpenMP flag
       DIST_NO_STDIO          no files: memory only
       DIST_NO_LIBC_ALLOC     no malloc: dist_context_desc.allocator is required
       DIST_NO_BACKWARD       no gradients, no Adam (implies DIST_NO_TRAIN)
       DIST_NO_TRAIN          no weight gradients, no dist_net_create
       DIST_NO_MESH           no isosurface, no Chamfer
       DIST_NO_HALF           no 16-bit kernels: dist_net_set_half refuses
       DIST_NO_PAPER          no DIST_TRACE_PAPER

   Conventions: world to camera x_cam = R x + t, x right, y down, z forward; pixel centers at integers unless the camera
   says otherwise; depth is z, distance is along the ray; images are (height, width[, channels]), top row first; points
   are (n, 3); a zeroed _desc means the defaults and NULL means the same; what a loss sends back (d_..., dist_gradients)
   is added to, never written; what is made, loaded or read is NULL on failure.

   Contents:
   @ 01 config, status, hooks   @ 02 context   @ 03 kernels   @ 04 field   @ 05 net   @ 06 camera
   @ 07 trace   @ 08 render   @ 09 loss   @ 10 optimizer   @ 11 mesh, metrics   @ 12 files
   @ 13 workspace
*/
#ifndef DIST_H
#define DIST_H

#define DIST_VERSION_MAJOR 0
#define DIST_VERSION_MINOR 2
#define DIST_VERSION_PATCH 0

#include <stddef.h>

#ifdef DIST_NO_BACKWARD
#ifndef DIST_NO_TRAIN
#define DIST_NO_TRAIN
#endif
#endif

#ifndef DIST_API
#if defined(DIST_STATIC) && (defined(__GNUC__) || defined(__clang__))
#define DIST_API static __attribute__((unused))
#elif defined(DIST_STATIC)
#define DIST_API static
#else
#define DIST_API extern
#endif
#endif

#ifdef __cplusplus
extern "C" {
#endif

/* ---- 01 config, status, hooks ------------------------------------------------------------------------------------ */

typedef int dist_status;
enum {
    DIST_OK = 0,
    DIST_BAD_ARGUMENT = -1,  /* the caller's: the sentence says which function, field, value and what would be right */
    DIST_OUT_OF_MEMORY = -2, /* the allocator returned NULL, or a size does not fit size_t */
    DIST_BAD_FILE = -3,      /* a model, image or mesh that does not parse */
    DIST_UNSUPPORTED = -4,   /* well-formed, but not something this library does */
    DIST_NOT_FINITE = -5,    /* NaN or infinity where a number is needed */
    DIST_IO = -6             /* a file cannot be opened, read or written */
};

/* "0.2.0" */
DIST_API const char *dist_version(void);

/* Memory. alloc_fn returns `bytes` bytes aligned to `alignment` (a power of two, at most 64) or NULL; free_fn gets the
   same pointer and size back, never NULL. Called by create, load, save, free and destroy functions, those that make
   meshes, sample or measure them, dist_shape_set_texture, dist_net_set_half and, for a field of your own or an analytic
   one, by the first call but dist_render_backward that wants the gradient of its code or color; by no other. Like every
   hook, it may use this library with other contexts than the one that calls it. Either both functions or none; none:
   malloc and free. */
typedef struct dist_allocator {
    void *user;
    void *(*alloc_fn)(void *user, size_t bytes, size_t alignment);
    void (*free_fn)(void *user, void *pointer, size_t bytes);
} dist_allocator;

/* Parallelism. run_fn calls task_fn(arg, index, worker) once for every index in 0..count-1, in any order, and returns
   when all are done. `worker` is 0..dist_context_desc.workers-1 and no two calls with one worker overlap.
   Fastest: each worker takes the next index when it is done with one; costs differ, and the largest come first where
   they are known. task_fn never calls back into run_fn; 64 KiB of stack are enough for it, your callbacks apart. Tried
   on 64 indices when the context is made; leaving one out, doing it twice and a worker out of range are refused. NULL:
   OpenMP when the compiler has it on, else serial. */
typedef void (*dist_task_fn)(void *arg, int index, int worker);
typedef struct dist_scheduler {
    void *user;
    void (*run_fn)(void *user, int count, dist_task_fn task_fn, void *arg);
} dist_scheduler;

/* Matrix product of the user's BLAS: C (m, n) = alpha op(A) op(B) + beta C, all row-major, op(X) = X or its transpose;
   lda, ldb, ldc are row strides in floats. Tried on a small product when the context is made; a wrong answer is
   refused. May be called from several workers at once. For layers at least dist_context_desc.blas_width wide, of nets
   that a context with a BLAS has loaded: others' units may stand in another order. */
typedef struct dist_blas {
    void *user;
    void (*sgemm_fn)(void *user, int transpose_a, int transpose_b, int m, int n, int k, float alpha, const float *a,
                     int lda, const float *b, int ldb, float beta, float *c, int ldc);
} dist_blas;

/* Told every failure as it happens, with the sentence that dist_context_message keeps only for the first. */
typedef struct dist_logger {
    void *user;
    void (*log_fn)(void *user, dist_status status, const char *message);
} dist_logger;

/* ---- 02 context -------------------------------------------------------------------------------------------------- */

/* Hooks in force, processor features, scratch memory, and the first failure with its sentence.
   One context serves one thread at a time; contexts are independent of each other. */
typedef struct dist_context dist_context;

enum {
    DIST_ISA_AUTO = 0, /* the best that this processor and this build have */
    DIST_ISA_SCALAR,
    DIST_ISA_SSE2,
    DIST_ISA_AVX2,   /* with FMA */
    DIST_ISA_AVX512, /* F, BW, DQ, VL */
    DIST_ISA_NEON    /* AArch64 */
};

typedef struct dist_context_desc {
    int workers; /* threads to use at most, up to 1024; 0: as many as OpenMP would, 1 without OpenMP. Required with a
                    scheduler */
    int isa; /* DIST_ISA_*; one that the processor lacks is refused. Bits are the same on all machines for one isa */
    dist_allocator allocator;
    dist_scheduler scheduler;
    dist_blas blas;
    dist_logger logger;
    int blas_width; /* 0: 192; layers of 128 and less were faster without in every run of bench/bench_blas.c */
} dist_context_desc;
/* What will be used: every 0 replaced by its default, hooks aside. isa: what this processor and build have at best. */
DIST_API dist_context_desc dist_context_desc_resolve(const dist_context_desc *desc);

/* desc may be NULL. Returns NULL only if memory cannot be had or half of an allocator is given; any other failure (a
   refused hook) comes back as a context whose status says so and with which every further call fails with that
   status. */
DIST_API dist_context *dist_context_create(const dist_context_desc *desc);
/* NULL is allowed, here as in every dist_..._destroy. Goes last: everything else that was made with it goes before. */
DIST_API void dist_context_destroy(dist_context *ctx);

/* First failure since the context was made or cleared. A NULL context: DIST_BAD_ARGUMENT. */
DIST_API dist_status dist_context_status(const dist_context *ctx);
/* Its sentence; "" if there was none; of a NULL context one that says so. Valid until it is cleared or destroyed. */
DIST_API const char *dist_context_message(const dist_context *ctx);
/* Forgets the failure. Not that of dist_context_create: such a context goes on refusing everything. */
DIST_API void dist_context_clear(dist_context *ctx);
/* DIST_ISA_* in force, and its name: "scalar", "sse2", "avx2", "avx512", "neon". */
DIST_API int dist_context_isa(const dist_context *ctx);
DIST_API const char *dist_isa_name(int isa);
DIST_API int dist_context_workers(const dist_context *ctx);

/* ---- 04 field ---------------------------------------------------------------------------------------------------- */

/* Tells d_sdf (count) for points first..first+count-1 once their sdf (count) and gradient (count, 3) are known;
   gradient may be NULL where weights' gradients are wanted. Called from several workers at once. */
typedef void (*dist_seed_fn)(void *seed_user, size_t first, size_t count, const float *sdf, const float *gradient,
                             float *d_sdf);

/* What is traced: a function of the point that is negative inside, positive outside, zero on the surface, within a
   bounding sphere. Yours, an analytic one below, or a network (dist_shape_field). A plain value: copy it freely.
   The callbacks must not call functions of this library with the same context; another field's eval_fn and fused_fn,
   with the same worker, they may. */
typedef struct dist_field {
    void *user;
    /* sdf[i] = f(points[i]) for n points (n, 3), any number; gradient (n, 3) is NULL or is set to df/dpoint.
       Called from several workers at once; worker is 0..dist_context_workers-1. */
    void (*eval_fn)(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient);
    /* d_code[j] += sum over i of d_sdf[i] * df(points[i])/dcode[j], j < code_size. NULL: there is no code, or fused_fn
       is set. */
    void (*adjoint_fn)(void *user, int worker, size_t n, const float *points, const float *d_sdf, double *d_code);
    /* Set by dist_shape_field, NULL in a field of your own: value, gradient and code adjoint in one pass, and the
       weights'. The adjoint_fn of a field that wraps a net's calls it, with a seed_fn that tells its d_sdf. */
    void (*fused_fn)(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient,
                     dist_seed_fn seed_fn, void *seed_user, double *d_code);
    dist_status (*weights_fn)(void *user, dist_context *ctx, size_t n, const float *points, float *d_sdf,
                              dist_seed_fn seed_fn, void *seed_user, float *d_points, double *d_code,
                              float *d_weights);
    /* Second derivatives, of s_i = directions[i] . grad f(points[i]) with directions (n, 3) of any length:
       d_points[i] += ds_i/dpoint = H(points[i]) directions[i], and d_code[j] += sum over i of ds_i/dcode[j] unless
       NULL. NULL: differences of grad f are taken. The other is the same with the weights, set by dist_shape_field. */
    void (*second_fn)(void *user, int worker, size_t n, const float *points, const float *directions, float *d_points,
                      double *d_code);
    dist_status (*second_weights_fn)(void *user, dist_context *ctx, size_t n, const float *points,
                                     const float *directions, float *d_points, double *d_code, float *d_weights);
    /* color (n, 3) at n points. NULL: this field has no color. */
    void (*color_fn)(void *user, int worker, size_t n, const float *points, float *color);
    /* With L = sum_i d_color[i] . color(points[i]): adds dL/dpoint to d_points (n, 3), dL/dcode to d_code and
       dL/d(color code) to d_color_code; each is NULL where it is not wanted. NULL: the color has no adjoint. */
    void (*color_adjoint_fn)(void *user, int worker, size_t n, const float *points, const float *d_color,
                             float *d_points, double *d_code, double *d_color_code);
    /* Set by dist_shape_field: the same for all n points at once, d_code followed by d_color_code in one array, and
       dL/dweights of the net that gives the color. */
    void (*color_weights_fn)(void *user, dist_context *ctx, size_t n, const float *points, const float *d_color,
                             float *d_points, double *d_code, float *d_weights);
    /* A cheaper eval_fn, off by about coarse_error at most, with the same arguments: field.eval_fn = field.coarse_fn
       takes it for everything; gradients are the exact ones. Set by dist_shape_field after dist_net_set_half. */
    void (*coarse_fn)(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient);
    float coarse_error;
    /* bounding sphere: the surface lies inside it, nothing is looked for outside, nor is f asked for there, but for
       rounding, a 1e-6 of the radius, by DIST_TRACE_PAPER, in the corners of its cube by dist_mesh_extract, and by
       differences, how.normal_delta beyond a hit */
    float center[3];
    float radius;    /* 1e-15 to 1e15 */
    /* bound or estimate of |grad f| where 0 < f < lipschitz_within. 0: 1, as distances have it: of a field of your own
       that is steeper much of the surface, or all, is stepped over. stats.steepest tells of it */
    float lipschitz;
    float lipschitz_within; /* 0: clamp / 2; without a clamp radius / 20 */
    float lipschitz_far;    /* the same where f is larger; 0: lipschitz */
    /* how.certified goes by these where they are larger than the two before, which may be those of most places: of a
       net by the steepest places that dist_shape_create found. certified_far 0: certified */
    float certified, certified_far;
    float clamp;     /* |f| above this carries no distance (a clamped training); 0: none */
    float detail;    /* the radius of the smallest part that is to be found: the defaults of how.epsilon, normal_delta
                        and of how far a ray goes on trust go by it; 0: radius */
    float noise;     /* how far rounding takes f off, part of every hit's error: counted as 5e-7 of the radius where
                        that is more. A net's is sampled by dist_shape_create */
    /* multiply-adds of a query, about; a net's field has its own. Below 5000 a picture without silhouette and tape is
       traced with more queries and less bookkeeping, its normals are those of the last sample, next to the hit: 1 where
       frames a second count, 0 where queries do */
    float cost;
    int kinks;       /* 1: grad f jumps (ReLU), which second_fn leaves out: a normal's gradient is by differences */
    int many;        /* 1: eval_fn is the faster the more points it gets at once, up to thousands */
    int code_size;   /* length of d_code; for a render's gradient of a field of your own at most 992,
                        or what a dist_field_backward with as long a code has made room for */
    size_t weight_count;       /* length of d_weights; 0: none */
    int color_code_size;       /* length of d_color_code */
    size_t color_weight_count; /* of a color net of its own; 0: the weights of color, if any, are among weight_count */
    /* whose weights, and whose a color net's of its own: instances of a scene that have the same share their part of
       the scene's. Set by dist_shape_field and dist_scene_field; NULL: nobody else's */
    const void *weights_of, *color_weights_of;
    dist_context *owner; /* the context that made it; NULL: any */
    /* a number that goes by what user points to, so that a cache or a tape of what it was is refused. The library's
       own fields have it, whose functions give 0 where eval_fn is not theirs any more; NULL: that is not looked at */
    unsigned (*changes_fn)(const struct dist_field *field);
    /* likewise by what only color goes by: where d_out.color is given, a tape of what it was is refused */
    unsigned (*color_changes_fn)(const struct dist_field *field);
    /* what is out of date, of the DISTI_STALE_* bits asked for: then it is refused. Set likewise */
    int (*stale_fn)(const struct dist_field *field, int what);
    unsigned taken; /* then: how many textures the shape had got, or what the scene's instances were. Set likewise */
    const struct dist_cache *cache; /* set by dist_cache_field; NULL: none */
} dist_field;

/* f = distance to a sphere, to a torus around the y axis, to an axis-aligned box (half extents), exact; each within its
   bounding sphere. Their code is the list of numbers given, in that order, so that gradients can be tried on them.
   A torus's distance is exact where the tube is no wider than the ring.
   The arrays are borrowed while the field is used; once their numbers have changed take the field anew: its sphere goes
   by them. A size below 0 becomes field.radius, which every call refuses. */
DIST_API dist_field dist_field_sphere(const float center_radius[4]);
DIST_API dist_field dist_field_torus(const float center_radii[5]); /* x y z, ring radius, tube radius */
DIST_API dist_field dist_field_box(const float center_half[6]);    /* x y z, half extents */

/* Values and, unless NULL, gradients of any field at n points; at one that is not finite they may be any number. A
   net's gradients of one to three points, or of as many that are left of n after pieces of 384, are rounded otherwise
   than others. */
DIST_API dist_status dist_field_eval(dist_context *ctx, const dist_field *field, size_t n,
                                     const float *points /* (n,3) */, float *sdf /* (n) */,
                                     float *gradient /* (n,3) or NULL */);
/* Colors (n, 3) of a field that has them, at n points. */
DIST_API dist_status dist_color_eval(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                     float *color);

#ifndef DIST_NO_BACKWARD
/* Where gradients go; NULL is not wanted and costs nothing. All are added to.
   rotation: tangent w of R' = exp([w]x) R; translation: of x_cam = R x + t; focal and principal: of the camera's
   numbers in pixels, to be stepped by adding to them. */
typedef struct dist_gradients {
    float *code;        /* (field.code_size) */
    float *rotation;    /* (3) */
    float *translation; /* (3) */
    float *weights;     /* (field.weight_count), the order of dist_net_weights */
    float *focal;       /* (2): dL/dfx, dL/dfy */
    float *principal;   /* (2): dL/dcx, dL/dcy */
    float *color_code;    /* (field.color_code_size) */
    float *color_weights; /* (field.color_weight_count), likewise of the texture */
} dist_gradients;

/* Adjoint of dist_field_eval: with L = sum_i d_sdf[i] f(points[i]), adds dL/dcode and dL/dweights to grads and
   d_sdf[i] * grad f(points[i]) to d_points (n, 3) unless NULL.
   d_sdf (n): the weights, in; with seed_fn it is filled from it instead: then value and adjoint cost one pass together.
   Points that are not finite, or whose d_sdf is not, add nothing; nor to weights does one at which a number in the net,
   or its derivative, is beyond 2^56.
   grads is not NULL, even for d_points alone; what it holds of camera and color must be NULL. */
DIST_API dist_status dist_field_backward(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                         float *d_sdf, dist_seed_fn seed_fn, void *seed_user, float *d_points,
                                         const dist_gradients *grads);

/* Adjoint of dist_color_eval: with L = sum_i d_color[i] . color(points[i]), d_color (n, 3), adds dL/dpoint to d_points
   (n, 3) unless NULL, and dL/dcode, dL/d(color code), dL/dweights of the net that gives the color to grads: its weights
   are grads->color_weights where it is a texture, grads->weights where it is the shape's own net. Points that are not
   finite, or whose d_color is not, add nothing. What grads holds of the camera must be NULL. */
DIST_API dist_status dist_color_backward(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                         const float *d_color, float *d_points, const dist_gradients *grads);

/* What makes f a distance: *loss = weight * mean over the n points of (|grad f| - 1)^2, and its gradient is added to
   grads->code and ->weights. loss and grads may be NULL; what grads holds of camera and color must be. An error leaves
   *loss alone. Points that are not finite, or whose f or gradient is not, add nothing, nor to weights those named at
   dist_field_backward. Exact where the field has second_fn (a ReLU's kinks have no share, as in automatic
   differentiation), else by differences over 1e-3 of the radius. */
DIST_API dist_status dist_field_eikonal(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                        float weight, float *loss, const dist_gradients *grads);
#endif

/* Places a shape in the world: x_world = scale rotation x_shape + translation. */
typedef struct dist_similarity {
    float scale;       /* above 0; 0: 1 */
    float rotation[9]; /* row-major; all 0: identity */
    float translation[3];
} dist_similarity;

/* scale *= exp(step[0]) (within 1e-30 to 1e30; one below 0 stays), rotation <- exp([step[1..3]]x) rotation, kept
   orthonormal, translation += step[4..6]: the step for a gradient of a placement's seven numbers, against it as in
   dist_camera_move. One that is not finite moves nothing. */
DIST_API void dist_similarity_move(dist_similarity *placement, const float step[7]);

/* A field and where it stands. */
typedef struct dist_instance {
    const dist_field *field; /* copied; what it points to is borrowed while the scene is used */
    dist_similarity placement;
} dist_instance;

/* Several instances as one field: f(p) = min over i of s_i f_i(R_i^T (p - t_i) / s_i). A point asks only the instances
   whose bounding spheres can hold the minimum, nearest first, and none of them outside its sphere: there f_i goes on as
   a lower bound of the distance, mostly below it, which rises slowly at first: where an instance nearly touches its
   sphere the silhouette of a ray just outside pulls little. The defaults of how.epsilon and normal_delta, and how far a
   ray goes on trust, go by the smallest instance's radius in the world, epsilon no smaller than float's noise, 5e-7 of
   the scene's. Every point is held against every sphere: fast up to some hundred instances; more are better made scenes
   of scenes. Belongs to the context that made it. */
typedef struct dist_scene dist_scene;
/* NULL on failure. count: 1 to 2^20. Instances may share fields; a scene's field may be an instance of another scene.
   Takes 264 bytes for each number of the scene's code, for sums of its gradient. */
DIST_API dist_scene *dist_scene_create(dist_context *ctx, int count, const dist_instance *instances);
DIST_API void dist_scene_destroy(dist_scene *scene);
/* Moves an instance or replaces its field (NULL: it stays) by one whose code is as long and that has of color, its code
   and its adjoint what the old one had. No allocator call. Take dist_scene_field again afterwards, and set it in a
   scene that holds this one: the bounding sphere changes, and where the weights stand. A field whose sphere an instance
   has left is refused. */
DIST_API dist_status dist_scene_set(dist_scene *scene, int index, const dist_instance *instance);
/* The scene as a field. Borrows the scene. Its code is, for each instance, its field's code (nothing if that has no
   adjoint), then its placement as dist_similarity_move has it: log-scale, w of R' = exp([w]x) R, translation;
   dist_gradients.code gets the gradients for all of them, with the bounding spheres of scenes held where they are,
   which matters outside of those alone. Its weights are those of the instances' nets, each net's once, in order of
   first use (a scene in it: that scene's). It has a color if every instance has, with an adjoint if each has one; its
   color code is theirs one after another, its color weights those of the textures, each texture's once; where only
   some instances have a texture the weights of color get no gradient. The gradient of its normals is that of
   differences over how.normal_delta, of smooth nets, too. */
DIST_API dist_field dist_scene_field(dist_scene *scene);
/* Where instance `index` begins in the scene's code; its placement are the seven numbers before instance index + 1.
   index = count: all of them. -1 out of range. */
DIST_API int dist_scene_offset(const dist_scene *scene, int index);
/* Where the weights of the net of instance `index` begin in the scene's, color 1: its texture's in the color's; of
   instances of one net the same. (size_t)-1 out of range. */
DIST_API size_t dist_scene_weight_offset(const dist_scene *scene, int index, int color);
/* Which instance f is least of at each of n points, index (n): after dist_trace, what was hit. Away from the surfaces
   that is not always the nearest, as f is a bound there: dist_field_closest_point, and then this. */
DIST_API dist_status dist_scene_find(dist_scene *scene, size_t n, const float *points, int *index);
/* Points that the instances' fields were asked since the scene was made. */
DIST_API unsigned long long dist_scene_queries(const dist_scene *scene);

/* ---- 05 net ------------------------------------------------------------------------------------------------------ */

/* Weights of a decoder, which nothing but dist_net_set_... changes, shared by any number of shapes and contexts. */
typedef struct dist_net dist_net;
/* Weights and one code, folded into the biases. Belongs to the context that made it. */
typedef struct dist_shape dist_shape;

enum {
    DIST_ACTIVATION_RELU = 0,
    DIST_ACTIVATION_ELU,
    DIST_ACTIVATION_SOFTPLUS, /* log(1 + exp(beta x)) / beta */
    DIST_ACTIVATION_SINE,     /* sin(omega x) */
    DIST_ACTIVATION_TANH,
    DIST_ACTIVATION_NONE
};

/* Reads a model in safetensors form; tensor names and metadata as the README's "Model files" says. The bytes are
   copied. A file is hostile until proved otherwise: NULL and a sentence for anything that does not fit. Takes twice a
   file in F32, four times one in 16 bits, and up to 32 bytes more for each input of a layer and 4 KB; no more on the
   way. */
DIST_API dist_net *dist_net_load(dist_context *ctx, const void *bytes, size_t size);
#ifndef DIST_NO_STDIO
/* A file of at most 2 GB; a sentence about it ends with its path. Saving, of pictures and meshes too, writes over what
   stands there: where it fails (a full disk) that is gone and what is left is cut off, so save what you cannot make
   again under another name and rename it. */
DIST_API dist_net *dist_net_load_file(dist_context *ctx, const char *path);
DIST_API dist_status dist_net_save_file(dist_context *ctx, const dist_net *net, const char *path);
#endif
DIST_API void dist_net_destroy(dist_net *net);
/* Writes what dist_net_load reads; the same net gives the same bytes. *size is set to the bytes needed; with buffer
   NULL nothing else happens; too small a capacity is refused. Plain weights are written, in F32. */
DIST_API dist_status dist_net_save(dist_context *ctx, const dist_net *net, void *buffer, size_t capacity, size_t *size);

enum {
    DIST_HALF_OFF = 0,
    DIST_HALF_AUTO, /* F16 where the processor has it, else BF16: Intel's with both take longer in that than in f32 */
    DIST_HALF_F16,  /* AVX512-FP16: 11 bits of mantissa, up to 65504 */
    DIST_HALF_BF16  /* AVX512-BF16: 8 bits */
};
/* Packs the hidden layers' weights once more, in 16 bits: F16 at the size of the f32 ones, BF16 at half of it. Shapes
   made afterwards have field.coarse_fn, and as field.coarse_error the largest difference to f32 met at 768 points of
   the bounding sphere when the shape is made: a sample, not a proof. The point's columns and the last layer stay in
   f32; a block in which anything overflows is evaluated in f32. DIST_UNSUPPORTED: a processor or build without these
   instructions, LayerNorm, weights beyond 65504 in F16 (set later, they turn it off); then what was in force stays, at
   first nothing. Without, and on contexts of another isa than DIST_ISA_AVX512, coarse_fn is NULL: dist_context_clear,
   where f32 will do. No shape of the net may be in use by another thread. */
DIST_API dist_status dist_net_set_half(dist_context *ctx, dist_net *net, int kind);
/* What is in force: DIST_HALF_OFF, F16 or BF16. */
DIST_API int dist_net_half(const dist_net *net);

DIST_API int dist_net_code_size(const dist_net *net);  /* 0: no code */
DIST_API int dist_net_code_count(const dist_net *net); /* codes stored in the file */
DIST_API const float *dist_net_code(const dist_net *net, int index); /* NULL out of range; borrowed from the net */
DIST_API int dist_net_channels(const dist_net *net);
DIST_API float dist_net_bound(const dist_net *net);    /* radius of the sphere that holds the shape */
/* Multiply-adds of one query with the code folded, and without folding. */
DIST_API size_t dist_net_operations(const dist_net *net, int folded);

/* All trainable numbers: for each layer its weight (out, in) as in the file, its bias (out), its norm's weight and
   bias. */
DIST_API size_t dist_net_weight_count(const dist_net *net);
DIST_API const float *dist_net_weights(const dist_net *net);

#ifndef DIST_NO_TRAIN
/* A new net with random weights, for training. Zero fields mean the defaults. */
typedef struct dist_net_desc {
    int layers;       /* hidden layers, 1 to 31; 0: 8 */
    int width;        /* units of each, 1 to 4096; 0: 512 */
    int skip;         /* linear layer 1..layers-1 that sees [x, input] again; 0: none */
    int code_size;    /* at most 4096; 0: none */
    int code_count;   /* codes stored beside the weights, zero at first; at most 10,000,000 */
    int activation;   /* DIST_ACTIVATION_* */
    float scale;      /* beta of softplus, omega of sine, 1e-6 to 1e6; 0: 100, 30 */
    int output_linear;/* 0: tanh at the end, 1: nothing */
    int levels;       /* Fourier levels beside the point: sin and cos of pi 2^k p, k below levels; at most 16 */
    int color;        /* 1: a texture: r, g, b in place of the distance, with a sigmoid at the end unless linear */
    int geometric;    /* 1: starts near the distance to a sphere of half the bound, where f is 0 in the mean; ReLU and
                         softplus only, of that best where scale * bound is some 30 or more (f grows slower than the
                         distance then: by half of it at 100). Fourier levels have no share in it, nor has the code: of
                         a code of zeros its gradient and that of its weights are 0, so begin with random ones.
                         0: PyTorch's start */
    float bound;      /* radius of the sphere that holds the shape, 1e-6 to 1e6; 0: 1 */
    float clamp;      /* 0: 0.1 with a code, none without one or of a texture; below 0: none */
    unsigned seed;
} dist_net_desc;
DIST_API dist_net_desc dist_net_desc_resolve(const dist_net_desc *desc); /* likewise; no clamp: 0 or below */
DIST_API dist_net *dist_net_create(dist_context *ctx, const dist_net_desc *desc);
/* Replace all weights (dist_net_weight_count) or one stored code. The caller sees to it that no shape is in use by
   another thread. After new weights each shape of the net wants dist_shape_set_code before it is used again, and is
   refused until then: it would have the new weights beside biases with its code and the old ones folded in. */
DIST_API dist_status dist_net_set_weights(dist_context *ctx, dist_net *net, const float *weights);
DIST_API dist_status dist_net_set_code(dist_context *ctx, dist_net *net, int index, const float *code);
#endif

/* code (dist_net_code_size) is copied; NULL means zeros: so does dist_net_code of an index that is not there. The net
   is borrowed until the shape is destroyed. */
DIST_API dist_shape *dist_shape_create(dist_context *ctx, const dist_net *net, const float *code);
DIST_API void dist_shape_destroy(dist_shape *shape);
/* code NULL: zeros. Fields and scenes of the shape have the new code at once. Their Lipschitz figures and coarse_error
   stay those that dist_shape_create sampled: what is thin, and how.certified, ask for a new shape where code or weights
   have come far. */
DIST_API dist_status dist_shape_set_code(dist_shape *shape, const float *code);
/* Color by a second net: rgb = g(code, color code, point), where g's code is the shape's followed by the color's; so
   dist_net_code_size(texture) is at least the shape's, and the rest is field.color_code_size. color_code is copied;
   NULL means zeros. The net is borrowed until the shape is destroyed or gets another texture; texture NULL takes it
   away. Fields taken before must be taken again, their color is refused. dist_shape_set_code sets the code of both. */
DIST_API dist_status dist_shape_set_texture(dist_shape *shape, const dist_net *texture, const float *color_code);
DIST_API dist_status dist_shape_set_color_code(dist_shape *shape, const float *color_code);
/* The field of the net's distance channel. Borrows the shape. A net without one (r,g,b) gives a field that render
   refuses. */
DIST_API dist_field dist_shape_field(dist_shape *shape);
/* All output channels (n, dist_net_channels) at n points, in the order of the file's dist.channels; the distance's is
   f = channel - dist.level. */
DIST_API dist_status dist_shape_eval(dist_context *ctx, dist_shape *shape, size_t n, const float *points,
                                     float *channels);

/* ---- 06 camera --------------------------------------------------------------------------------------------------- */

/* Pinhole camera. A world point x is seen at x_cam = rotation x + translation (row-major, x right, y down, z forward),
   pixel u = fx X/Z + skew Y/Z + cx, v = fy Y/Z + cy. */
typedef struct dist_camera {
    float fx, fy, cx, cy, skew; /* pixels; fx and fy not 0, below 0: mirrored */
    float rotation[9]; /* rows off orthonormal by up to 1e-3 are made exact, more is refused. dist_camera_move by 0
                          projects it; a matrix with a scale is to be divided by that before */
    float translation[3];
    int width, height;  /* 1 to 65536 */
    float pixel_center; /* coordinate of the first pixel's center: 0 (OpenCV, the authors) or 0.5 (COLMAP, OpenGL) */
} dist_camera;

/* fx = fy = height / 2 / tan(fov_y / 2), cx = (width - 1) / 2, cy = (height - 1) / 2, pixel centers at integers.
   eye and at: NULL is the origin. Degenerate input (eye = at, up along the view or NULL) is repaired by another up;
   what cannot be repaired, such as fov_y in degrees or what is not finite, makes fx 0, which the function that takes
   the camera refuses. */
DIST_API dist_camera dist_camera_look_at(int width, int height, float fov_y /* radians, above 0, below pi */,
                                         const float eye[3], const float at[3], const float up[3]);
/* camera_to_world: row-major 3 x 4 or the upper part of 4 x 4, x right, y up, z backward (OpenGL, Blender, NeRF). */
DIST_API void dist_camera_set_opengl(dist_camera *camera, const float camera_to_world[12]);
DIST_API void dist_camera_get_opengl(const dist_camera *camera, float camera_to_world[12]);
/* COLMAP's images.txt: quaternion w x y z and translation, world to camera; sets pixel_center to 0.5.
   A zero quaternion is refused, another length normalized. */
DIST_API dist_status dist_camera_set_colmap(dist_camera *camera, const float quaternion[4], const float translation[3]);
DIST_API void dist_camera_get_colmap(const dist_camera *camera, float quaternion[4], float translation[3]);
/* rotation <- exp([w]x) rotation, kept orthonormal; translation += t. The step for a gradient of dist_gradients:
   minus a rate times it, or what dist_adam_step makes of six zeros. One that is not finite moves nothing. */
DIST_API void dist_camera_move(dist_camera *camera, const float w[3], const float t[3]);
/* Center of projection -R^T t and unit direction of pixel (x, y), in world coordinates. */
DIST_API void dist_camera_ray(const dist_camera *camera, float x, float y, float origin[3], float direction[3]);

/* ---- 07 trace ---------------------------------------------------------------------------------------------------- */

enum { DIST_TRACE_GUARDED = 0, DIST_TRACE_PAPER = 1 };
enum { DIST_PAPER_COARSE_TO_FINE = 0, DIST_PAPER_AGGRESSIVE, DIST_PAPER_DYNAMIC, DIST_PAPER_PARALLEL };
/* Of depth: IMPLICIT: -df / (grad f . v), exact at the hit. NORMAL: that, with the lens's own share, times |n . v|, so
   that grazing pixels do not dominate. PAPER: alpha times the sum of df over the K = how.samples samples of smallest
   |f|, but for those beyond .1 of the bounding radius; with the guarded tracer all K are the hit, so that it grows with
   K. As the hit moves so does the color that is seen, with the same weights; normals move exactly, but with PAPER not
   at all. */
enum { DIST_GRADIENT_AUTO = 0, DIST_GRADIENT_IMPLICIT, DIST_GRADIENT_NORMAL, DIST_GRADIENT_PAPER };
enum { DIST_NORMAL_ANALYTIC = 0, DIST_NORMAL_DIFFERENCE = 1 };
enum { DIST_SPACE_CAMERA = 0, DIST_SPACE_WORLD = 1 };
/* Of a ray that starts in the solid, DIST_RAY_INSIDE: no hit; a hit at its start, without pull on the shape; or
   DIST_RAY_HIT where it leaves the solid, with gradients as any (with DIST_TRACE_PAPER: no hit). */
enum { DIST_INSIDE_BACKGROUND = 0, DIST_INSIDE_HIT = 1, DIST_INSIDE_EXIT = 2 };

enum {
    DIST_RAY_MISS = 0,   /* nothing there */
    DIST_RAY_HIT,        /* the distance is within its error bound, see dist_images.error */
    DIST_RAY_UNRESOLVED, /* budget spent: mask 0, distance of the sample of smallest |f|, or where neighbors or cones
                            say; a surface, if there is one, is no farther from there than the error. Or it missed the
                            surface, of an f steeper than its figure, and the silhouette found the solid */
    DIST_RAY_INSIDE,     /* started inside the solid, but for those of DIST_INSIDE_EXIT that leave it */
    DIST_RAY_PLATEAU,    /* f is small and flat: no crossing within reach; mask 0 */
    DIST_RAY_NOT_FINITE, /* the field gave NaN or infinity: mask 0 */
    DIST_RAY_SKIPPED     /* not asked for (how.pixels): mask 0, silhouette 0, no query, no gradient */
};

/* `how` in comments and messages. */
typedef struct dist_render_desc {
    int max_steps; /* queries per ray at most, to 60000, and up to 40 more to where f has crossed 0 between two of them;
                      0: 300 guarded, 10000 certified, 50 paper */
    float step_scale;    /* alpha, above 0, to 100; 0: 1.5 (paper: rows aggressive and coarse-to-fine; of the others 1
                            whatever it is) */
    float epsilon; /* largest |f| of a hit, shape units, which those interpolated between hits alike may exceed; 0: 5e-5
                      of the bounding radius or field.detail, or less where a pixel is smaller (paper: 5e-5). The
                      guarded tracer takes at most half of field.clamp */
    int samples;         /* K of the paper's gradient, 1 to 8; 0: 1 */
    int trace;           /* DIST_TRACE_*; dist_trace: 0 */
    int paper_row;       /* DIST_PAPER_* */
    int gradient;        /* DIST_GRADIENT_*; AUTO: IMPLICIT with the guarded tracer, PAPER with the paper's */
    float gradient_cap;  /* tau, to 1: |grad f . v| counts as at least tau |grad f|; 0: 0.1 */
    int normal_mode;     /* DIST_NORMAL_* */
    float normal_delta;  /* half step of differences, shape units, 1e-6 to 1 of the radius; 0: 1e-3 of the bounding
                            radius or field.detail */
    int normal_space;    /* DIST_SPACE_* */
    int inside;          /* DIST_INSIDE_* */
    float background;    /* depth and distance at a miss, finite */
    float background_color[3];
    float lipschitz;     /* 0: the field's */
    float relax_band; /* above 0, with a tape: d_out's color beside the outline says where it is to go, by the rays that
                         miss by less than this, shape units: one or two pixels' width; too strongly, by about half the
                         band over the outline's radius (the camera's distance, focal lengths: twice that). For losses
                         that compare color without a mask; 0: off */
    int no_cones;        /* 1: every ray marches from the bounding sphere by itself */
    int no_prediction;   /* 1: no ray starts from what its neighbors found */
    int certified;       /* 1: only steps that the Lipschitz figures prove, field.certified where that is larger, for
                            one to four times the queries of a small picture, four to ten of a large one, more where
                            f stays small beside outlines; nothing is missed but, now and then, a curved sheet without
                            depth, nor seen by more than epsilon too far away, where they are bounds: a net's are the
                            steepest slopes sampled, dist_stats.steepest says when these were too small */
    /* dist_trace only. any_hit 1: a ray ends as soon as anything is certain to block it, for shadows; its distance is
       then that of a sample inside what blocks, its error how far before that it goes in. max_distance: how far a ray
       looks, in lengths of its direction (1: from origin to origin + direction); 0 or INFINITY: without end */
    int any_hit;
    float max_distance;
    int warm_start;      /* 1: start from the picture in the tape, see dist_tape_create; guarded tracer, pictures */
    /* (height, width): only pixels that are not 0 are traced. Read during dist_render; NULL: all. dist_trace: NULL */
    const unsigned char *pixels;
    unsigned long long max_queries; /* queries of one call at most; 0: no limit. Shared out over the tiles by their
                            pixels in the bounding sphere's rectangle (dist_trace: over groups of 1024 rays), so the
                            bits do not depend on threads; a tile spends its share on cones first, then on every 8th
                            pixel, 4th and so on, and keeps what its hits' normals and colors cost. Rays that it does
                            not finish are UNRESOLVED, and what it does not use is not another's: a picture needs
                            more room than the queries that it takes without a limit */
} dist_render_desc;

/* What will be used: every 0 replaced by its default; the guarded tracer's epsilon, normal_delta and lipschitz, which
   go by the field, stay 0. */
DIST_API dist_render_desc dist_render_desc_resolve(const dist_render_desc *desc);

typedef struct dist_stats {
    unsigned long long rays;            /* asked for */
    unsigned long long rays_in_sphere;  /* of them, those that meet the bounding sphere */
    unsigned long long queries;         /* points at which f was evaluated, everything included */
    unsigned long long cone_queries, march_queries, refine_queries, silhouette_queries,
        normal_queries, color_queries; /* their parts */
    unsigned long long hits;            /* mask 1: with DIST_INSIDE_HIT those INSIDE, too */
    unsigned long long unresolved, inside, plateau, not_finite;
    unsigned long long capped;          /* backward: rays whose grad f . v was capped, or grad f 0: then without pull */
    unsigned long long backward_points; /* backward: points through the adjoint */
    unsigned long long skipped;         /* backward: pixels with no upstream gradient at a hit or of the silhouette */
    double operations; /* multiply-adds a dense net would have done for the queries; 0 if the field is not a net */
    double operations_done;             /* of them, those not left out as dead units */
    float epsilon;                      /* the |f| in force, smallest over the picture */
    float lipschitz;                    /* in force */
    float steepest; /* the figure that samples following one another along a ray called for, where that is above the
                       one in force, else 0: then how.certified proves nothing, render again with more than this. Where
                       nobody told one (field.lipschitz 0), that samples all over the sphere called for, too: five for
                       every 256 rays, 80 at most */
    float error; /* largest over the hits of what dist_images.error has: at a grazing ray on an outline that bound is
                    much larger than the error, so this tells of the worst pixel, not of the picture */
} dist_stats;

/* One free ray's result. Distances are along the unit direction, how.max_distance is in lengths of the one given. */
typedef struct dist_hit {
    float distance; /* of the hit, or of the sample of smallest |f|; a ray without one: nearest to the center */
    float error;    /* bound on the distance's error, as good as f's slopes are sampled; no neighbors are asked */
    float sdf;      /* f there, within epsilon of 0 at a hit (any_hit: or inside); 3e38: no sample */
    int status;     /* DIST_RAY_* */
} dist_hit; /* DIST_RAY_NOT_FINITE: distance, error and sdf say nothing */

/* Traces n rays (origins (n, 3), directions (n, 3) of any length; numbers below 1.2e-38 are 0) with the guarded tracer:
   picking, shadows, visibility. The first surface in front of each origin; with how.any_hit any of them. A ray that is
   0 or not finite is DIST_RAY_NOT_FINITE. No cone and no neighbor helps a free ray to see what is thin: with
   how.certified it asks more, and steps over nothing as far as the Lipschitz figures are bounds. A hit is as often just
   inside as just outside: a shadow ray sets out a little along the normal, some thousandths of the radius. stats may be
   NULL. */
DIST_API dist_status dist_trace(dist_context *ctx, const dist_field *field, size_t n, const float *origins,
                                const float *directions, const dist_render_desc *how, dist_hit *hits,
                                dist_stats *stats);

/* The nearest point of the surface to each of n points: steps along the gradient onto the surface, then along the
   surface as long as that brings it nearer, then a look around, through the cells of an octree (16 along each side of
   the cube around the bounding sphere) that the figures for how.certified do not show to be empty. Of a distance it is
   as far off as the nearest to within 1e-4 of the radius, but for one to six in a thousand of the points beyond the
   sphere where parts are small (by up to .014); of a trained decoder to within a 500th but for one in 80, or one in 25
   (a fox), by up to .013, from far away, too: two parts of the surface in one cell may be taken for one. Where walls
   are thinner than a cell (a camera's) more than one in four is off by more, one in 18 by more than a 100th, the worst
   by .04, and of spheres that are in by a 50th one in 130, or more beside the bounding sphere, is told to be clear. Of
   a field clamped below a tenth of its radius the cells tell little: a part that is not the nearest, or none, may be
   what is found. Inside the sphere a distance is asked for 2 samples a point, mostly; a decoder from far away for 40
   to 140 a point of some hundred in one call, which share the cells, and for 300 to 2300 of a point alone. A cache
   spares the cells that it shows to be empty. Of a scene each instance that may be nearest is gone to by itself; what
   is of one within another is no surface. closest (n, 3); distance (n) signed, below 0 inside, and status (n) may be
   NULL: DIST_RAY_HIT, DIST_RAY_UNRESOLVED (no surface found: the last point tried), DIST_RAY_NOT_FINITE (closest is
   the point, distance 3e38). Nothing is asked outside the bounding sphere. */
DIST_API dist_status dist_field_closest_point(dist_context *ctx, const dist_field *field, size_t n,
                                              const float *points, float *closest, float *distance,
                                              unsigned char *status);

/* What is empty of a field's bounding sphere, in a grid, for what stands still and is asked often. The rays of
   dist_trace pass what it shows to be empty without a query, and find what they find without it to within the error
   bounds, but for rays that just touch the surface; a sphere of dist_field_collide asks nothing where the grid shows it
   to be clear, a small one from a cell or two off the surface on. Empty is what the field's Lipschitz figures allow no
   surface in, as for a picture's cones; pictures, whose rays help each other, do without. bench/bench_cache.c prints
   what it saves: from a quarter to three quarters of the rays' queries. Belongs to the context that made it. */
typedef struct dist_cache dist_cache;
/* resolution: cells along each side of the cube around the bounding sphere, a multiple of 8 to 512; 0: 64. Takes
   resolution^3 bytes, and 8 to 14 resolution^2 queries to make. NULL on failure. */
DIST_API dist_cache *dist_cache_create(dist_context *ctx, const dist_field *field, int resolution);
DIST_API void dist_cache_destroy(dist_cache *cache);
/* The field with its cache, to be traced instead of it. Borrows both. As soon as the shape's code, the net's weights or
   the scene have changed every call that asks for distances refuses it, nearest points and contacts of a scene with
   such an instance, too; a field of your own without changes_fn must not change. A cache serves Lipschitz figures up to
   those it was made with: raise field.lipschitz, lipschitz_far before, not how.lipschitz. With how.certified it is used
   only where it was made with figures as large as field.certified and certified_far. */
DIST_API dist_field dist_cache_field(const dist_cache *cache);
/* Makes it anew for a field that has changed, or another one; then take dist_cache_field again. No allocator call. */
DIST_API dist_status dist_cache_update(dist_cache *cache, const dist_field *field);
/* What it took to make it. */
DIST_API unsigned long long dist_cache_queries(const dist_cache *cache);

/* A sphere against a field. */
typedef struct dist_contact {
    float depth;     /* how far the sphere is in; below 0: they are at least so far apart, as far as that is exact */
    float normal[3]; /* unit, out of the field: moving the sphere by depth * normal ends the contact; 0 without one */
    float point[3];  /* of the surface, the deepest in the sphere; the sphere's center where there is no contact */
    int status;      /* DIST_RAY_HIT: they touch; DIST_RAY_MISS; else as dist_field_closest_point, NOT_FINITE also where
                        the sphere is not finite */
} dist_contact;

/* n spheres (n, 4), center and radius (below 0: refused), against the field. A sphere that is clear of it, by the
   figures for how.certified (lipschitz 0: 1, so not of a steeper field) or those that its cache was made with, costs
   one query, or none where it is clear of the bounding sphere. For how far a sphere can go ask for its contacts on the
   way: f less its radius is no field to trace, since f need not be a distance away from the surface. */
DIST_API dist_status dist_field_collide(dist_context *ctx, const dist_field *field, size_t n, const float *spheres,
                                        dist_contact *contacts);

/* ---- 08 render --------------------------------------------------------------------------------------------------- */

/* Planes of width * height entries, top row first; NULL: not computed. As d_out of dist_render_backward the float
   planes hold dL/d(plane) and are only read. Planes, how.pixels among them, must not overlap: that is not checked. */
typedef struct dist_images {
    float *depth;          /* z in camera space; how.background where the ray is neither a hit nor UNRESOLVED */
    float *distance;       /* along the ray; likewise */
    float *normal;         /* (h, w, 3), unit, outward, in how.normal_space (the camera's); 0 at a miss */
    float *silhouette;     /* min |f| along the ray - epsilon, signed: < 0 at a hit, > 0 at a miss. Far from the
                              outline, mostly from |f| of about .05 of the radius on, in coarse pictures from more, it
                              is interpolated or another local minimum; so are 7 in 10,000 rays right beside the
                              outline of one of two parts. Of a ray beside the bounding sphere its distance from that */
    float *color;          /* (h, w, 3); how.background_color at a miss and where it is not finite */
    unsigned char *mask;   /* 1 hit, 0 not: the authority */
    unsigned char *status; /* DIST_RAY_* */
    float *error;          /* bound on the error of distance, as good as f's slopes are sampled; 0 where that is the
                              background. Behind the edge of a nearer surface it reaches to that; with
                              how.certified only where a slope beyond the Lipschitz figure was met in the same tile.
                              It knows nothing of a part two or three pixels wide that hovers before a surface and
                              that all of a pixel's neighbors miss: how.no_prediction looks for those.
                              With field.coarse_fn for eval_fn field.coarse_error is counted in, near outlines by
                              what is seen beside; a ray that just meets an edge may go on far behind it. Where a
                              ray crept along a surface before its hit, up to 0.02 of the radius of that way, too.
                              With warm_start of the surface that is seen: another one may be seen late (dist_tape).
                              DIST_TRACE_PAPER: |f| of a hit's sample, no bound */
    dist_stats *stats;     /* set by dist_render, added to by dist_render_backward */
} dist_images;

/* Keeps what the gradient needs: one distance and one status a pixel, and the paper's K samples where asked for. */
typedef struct dist_tape dist_tape;
/* For pictures of exactly this camera's size and of this desc's trace and samples.
   With desc->warm_start the tape also keeps what the next picture can start from (22 bytes a pixel more). A dist_render
   with warm_start then verifies the last picture's hits and near misses, one query each or none, instead of marching.
   It is meant for an optimization that moves the surface by less than about a pixel a step. Whatever does not
   verify, and every tile in which much has moved, is traced anew; so is the whole picture after a change of camera, of
   field (the shape itself may get a new code) or of epsilon. What is certain: what lies before the cones' stops (blocks
   of 16 x 16 pixels, 8 x 8 with a silhouette) is empty as far as the Lipschitz figure is right, as in a cold render.
   Every hit lies on the surface within its error bound, but those without a query, moved as their neighbors are and
   asked within 16 renders, only where neighbors see alike: not where the surface has bumps finer than two pixels.
   Between the cones' stop and the hit a surface that comes out of nothing is noticed at once if f where the cones stop
   betrays it, else by the rays that are marched anew in turn: a pixel after 512 renders at the latest (256 if it was a
   miss), after 128 (64) if f at the picture's hits changes by more than 0.0004 of the radius a render, on average. What
   such a ray finds is followed to its neighbors, within a tile at once where it is nearer by a hundredth of the radius,
   else pixel by pixel. Without a silhouette a miss that the surface nearly touches is looked at on both sides of that
   place every second render, where f has hardly changed there every eighth: an outline may be so late. With one a
   pixel beside the outline may keep another least |f| than a cold render finds, off by less than a pixel's width, and
   for some hundred renders after all stands still. */
DIST_API dist_tape *dist_tape_create(dist_context *ctx, const dist_camera *camera, const dist_render_desc *desc);
DIST_API void dist_tape_destroy(dist_tape *tape);

/* Traces one ray per pixel and fills the planes that are not NULL. desc and tape may be NULL.
   The tape borrows what the field points to until its last dist_render_backward, which refuses another code, other
   weights or instances that have moved: the gradient would be neither's; what a field of your own points to must be
   what it was. No allocator call.
   Rays that miss: mask 0, depth and distance desc->background, normal 0, silhouette > 0. UNRESOLVED: mask 0, normal 0,
   depth and distance the best so far. What is refused writes nothing and leaves the tape as it was. */
DIST_API dist_status dist_render(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                 const dist_render_desc *desc, const dist_images *out, dist_tape *tape);

#ifndef DIST_NO_BACKWARD
/* Adjoint of the dist_render that filled the tape: reads d_out's depth, distance, normal, color, and silhouette if that
   was rendered; adds to grads; with how.relax_band color also at misses: outlines move, though not those that lie
   before another surface. Of DIST_RAY_INSIDE only the silhouette counts: |f| where the ray starts, or f where
   how.inside makes a hit of it; a silhouette beside the bounding sphere is the camera's alone, not a scene's
   placements'. The least |f| of a ReLU net lies at a kink: the silhouette's gradient is that of one side; at a hit it
   is that of f there. What is not finite in d_out counts as 0. d_out->stats, if given, gets capped, backward_points and
   skipped added. No allocator call. */
DIST_API dist_status dist_render_backward(dist_context *ctx, const dist_tape *tape, const dist_images *d_out,
                                          const dist_gradients *grads);
#endif

/* ---- 09 loss ----------------------------------------------------------------------------------------------------- */

/* Each returns weight * loss and adds its gradient to the d_ array unless that is NULL. n: pixels. Means are over the
   pixels that count; none, or a plane that is NULL: 0 and no gradient. Sums are kept in double.
   A target counts where it is finite, a depth where 0 < target < 1e5; mask may be NULL: then every pixel is a hit. What
   is not finite does not count: a loss does not tell that a code or a picture is spoiled. Nor does such a weight: 0. */

/* mean |depth - target| over hit, observed pixels. A pixel that the shape does not cover has no say, and where none is
   covered the loss is 0: dist_loss_silhouette beside it keeps the shape where it was seen. */
DIST_API float dist_loss_depth(size_t n, const float *depth, const float *target, const unsigned char *mask,
                               float weight, float *d_depth);
/* mean -(normal . target) over hit pixels whose target normal (n, 3) is finite and not 0; the target is normalized */
DIST_API float dist_loss_normal(size_t n, const float *normal, const float *target, const unsigned char *mask,
                                float weight, float *d_normal);
/* mean over all pixels of S_gt max(0, S) + (1 - S_gt) max(0, -S); S_gt = target[i] != 0              (paper, eq. 8)
   Of a shape that is too large it tells hardly more than none: S at a hit is about -epsilon, however far beyond the
   outline. Its gradient does pull there; compare what was reached by the mask. */
DIST_API float dist_loss_silhouette(size_t n, const float *silhouette, const unsigned char *target, float weight,
                                    float *d_silhouette);
/* The same as the paper's authors average it: the mean of S over the pixels with S_gt = 1 and S > 0, plus the mean of
   -S over those with S_gt = 0 and S < 0. It does not fade as the wrong pixels become few. For use beside a mean
   over depths: alone it can run away */
DIST_API float dist_loss_silhouette_wrong(size_t n, const float *silhouette, const unsigned char *target, float weight,
                                          float *d_silhouette);
/* mean |color - target| over hit pixels and channels */
DIST_API float dist_loss_color(size_t n, const float *color, const float *target, const unsigned char *mask,
                               float weight, float *d_color);
/* |code|^2; n: its length */
DIST_API float dist_loss_code(size_t n, const float *code, float weight, float *d_code);

/* A photo with what was rendered from its camera; planes of camera.width * camera.height. */
typedef struct dist_photo {
    const float *color;        /* (h, w, 3), 0 to 1; what is not finite does not count: a mask, if one is wanted */
    const float *depth;        /* z in camera space, as dist_render gives it */
    const unsigned char *mask; /* 1 where the depth is a hit; NULL: everywhere */
    dist_camera camera;
} dist_photo;

typedef struct dist_photometric_desc {
    float visibility;       /* largest squared difference of the two depths, world units; 0: 1e-3; negative: any */
    float ssim;             /* share of structural similarity, 0 to 1 */
    /* Not written where something is refused. */
    float *warped;          /* (h, w, 3) of `to`: gets what `from` shows of it, 0 where nothing; NULL: not wanted */
    unsigned char *visible; /* (h, w) of `to`: gets 1 at the pixels that count; NULL: not wanted */
} dist_photometric_desc;
DIST_API dist_photometric_desc dist_photometric_desc_resolve(const dist_photometric_desc *desc); /* likewise */

/* Photo `from` warped into view `to` through the depth of `to` and compared with what `to` saw:
       p = unproject_to(x, depth), x' = project_from(p),
       (1 - ssim) mean |I_to(x) - I_from(x')| + ssim mean (1 - SSIM)/2,      bilinear I_from; SSIM over 3 x 3 pixels
   over the channels and the pixels that hit, 0 < depth < 1e5 as of a target, lie more than 1e-9 in front of `from` and
   inside its picture, and are not hidden there:
   (z of p in `from` - its depth at x')^2 < visibility; from->depth may be NULL: nothing is hidden. Windows of SSIM
   (uniform; 1e-4 and 9e-4 its constants) count where all nine pixels do. Adds dL/ddepth of `to` to d_depth (h, w) and,
   each unless NULL, dL/d(rotation, translation) of `to` and then of `from` to d_cameras (12), at this depth: what the
   depth itself does as the camera moves is dist_render_backward's to add. What is visible is held constant; from's
   depth at x' is the bilinear mean of the corners that are hits. desc may be NULL. A camera that dist_render refuses,
   an ssim out of range, a visibility that is not finite: 0 and no gradient. */
DIST_API float dist_loss_photometric(const dist_photo *to, const dist_photo *from, const dist_photometric_desc *desc,
                                     float weight, float *d_depth, float d_cameras[12]);

/* ---- 10 optimizer ------------------------------------------------------------------------------------------------ */

#ifndef DIST_NO_BACKWARD
/* Adam. moments (2 n floats) is the caller's, zeroed before the first step. Zero fields mean the defaults. */
typedef struct dist_adam {
    float *moments;
    float rate;    /* 0: 1e-2; negative: exactly no movement */
    float beta1;   /* 0 or less, or 1 or more: 0.9 */
    float beta2;   /* likewise: 0.999 */
    float epsilon; /* 0: 1e-8 */
    int step;      /* steps taken so far */
} dist_adam;
/* x (n) moves against gradient (n). A number that is not finite, or whose gradient or moment is not, stays as it was,
   its moments too; returns how many did: n, all, where x, gradient or adam->moments is NULL or the rate not finite. */
DIST_API size_t dist_adam_step(dist_adam *adam, size_t n, float *x, const float *gradient);
#endif

/* ---- 11 mesh, metrics -------------------------------------------------------------------------------------------- */

#ifndef DIST_NO_MESH
/* Triangles, counterclockwise seen from outside. Made by the functions below, ended by dist_mesh_destroy. */
typedef struct dist_mesh {
    float *vertices;     /* (vertex_count, 3) */
    float *normals;      /* (vertex_count, 3), unit, outward, 0 where grad f is; NULL if not asked for */
    unsigned *triangles; /* (triangle_count, 3) */
    size_t vertex_count;
    size_t triangle_count;
    dist_context *owner; /* as the two below: the library's own */
    size_t vertex_capacity, triangle_capacity;
} dist_mesh;

typedef struct dist_mesh_desc {
    int resolution; /* cells along each side of the cube around the bounding sphere, 2 to 2048 and no smaller than four
                       floats are apart there; 0: 128 */
    float level;    /* the isosurface f = level */
    int no_skip;    /* 1: evaluate every cell, also those that the Lipschitz figure rules out */
    int normals;    /* 1: also normals, one gradient query a vertex */
    int refine;     /* Newton steps that move vertices onto the surface, 0 to 8 */
} dist_mesh_desc;
DIST_API dist_mesh_desc dist_mesh_desc_resolve(const dist_mesh_desc *desc); /* likewise */

/* f = level within the field's bounding sphere's cube: closed unless the surface leaves the cube or, without no_skip,
   the Lipschitz figure, which of nets is a sample, rules out a cell that it goes through. An empty surface is a
   mesh of no triangles, not an error. NULL on failure. */
DIST_API dist_mesh *dist_mesh_extract(dist_context *ctx, const dist_field *field, const dist_mesh_desc *desc);
/* Copies the arrays; an index out of range or a vertex that is not finite is refused. */
DIST_API dist_mesh *dist_mesh_create(dist_context *ctx, size_t vertex_count, const float *vertices,
                                     size_t triangle_count, const unsigned *triangles);
DIST_API void dist_mesh_destroy(dist_mesh *mesh);
#ifndef DIST_NO_BACKWARD
/* Adjoint of extraction: a vertex moves by dv = -n df / |grad f|, so d_vertices (vertex_count, 3) reaches the
   field's code and weights. The camera's and the color's members of grads must be NULL. */
DIST_API dist_status dist_mesh_backward(dist_context *ctx, const dist_field *field, const dist_mesh *mesh,
                                        const float *d_vertices, const dist_gradients *grads);
#endif

/* n points (n, 3), uniform over the area, the same for the same seed. Refused: a mesh whose area is 0 or not
   finite, an index out of range. */
DIST_API dist_status dist_mesh_sample(dist_context *ctx, const dist_mesh *mesh, unsigned seed, size_t n, float *points);

/* Chamfer distance as DeepSDF defines it: mean over a of squared distance to the nearest of b, plus the same the
   other way. a (n, 3), b (m, 3). one_way[0], [1] get the two parts unless NULL. Allocates. */
DIST_API dist_status dist_chamfer(dist_context *ctx, size_t n, const float *a, size_t m, const float *b,
                                  double *chamfer, double one_way[2]);
#endif

/* ---- 12 files ---------------------------------------------------------------------------------------------------- */

/* PFM: channels 1 or 3, little-endian, bottom row first in the file, top row first in memory.
   *size gets the bytes needed; buffer NULL: only that. */
DIST_API dist_status dist_pfm_write(dist_context *ctx, int width, int height, int channels, const float *pixels,
                                    void *buffer, size_t capacity, size_t *size);
/* Reads the header; then, pixels not NULL, the picture into it (capacity in floats). Either byte order. */
DIST_API dist_status dist_pfm_read(dist_context *ctx, const void *bytes, size_t size, int *width, int *height,
                                   int *channels, float *pixels, size_t capacity);
#ifndef DIST_NO_STDIO
DIST_API dist_status dist_pfm_save(dist_context *ctx, const char *path, int width, int height, int channels,
                                   const float *pixels);
/* Loads into memory of the context's allocator; give it back with dist_pfm_free. */
DIST_API float *dist_pfm_load(dist_context *ctx, const char *path, int *width, int *height, int *channels);
#endif
DIST_API void dist_pfm_free(dist_context *ctx, float *pixels, int width, int height, int channels);

#ifndef DIST_NO_MESH
/* Mesh files in memory. read: PLY (ascii, binary of either order; triangles and polygons), OBJ (v, f; polygons
   fanned), OFF; told apart by their first bytes; normals and faces of fewer than three corners are left out. write:
   PLY binary, or OBJ. */
enum { DIST_MESH_PLY = 0, DIST_MESH_OBJ = 1 };
DIST_API dist_mesh *dist_mesh_read(dist_context *ctx, const void *bytes, size_t size);
DIST_API dist_status dist_mesh_write(dist_context *ctx, const dist_mesh *mesh, int format, void *buffer,
                                     size_t capacity, size_t *size);
#ifndef DIST_NO_STDIO
/* Positions and triangles: dist_mesh_read of the file. */
DIST_API dist_mesh *dist_mesh_load(dist_context *ctx, const char *path);
/* By the name's ending: .ply or .obj. */
DIST_API dist_status dist_mesh_save(dist_context *ctx, const dist_mesh *mesh, const char *path);
#endif
#endif

/* ---- 13 workspace ------------------------------------------------------------------------------------------------ */

/* What is to be made, in this order. Zero or NULL: not this. */
typedef struct dist_workspace_desc {
    const dist_context_desc *context; /* dist_context_create; NULL: its defaults */
    const void *model, *texture;      /* dist_net_load of these bytes, for the shapes and for their texture */
    size_t model_size, texture_size;
    const dist_net *net, *texture_net; /* where these are NULL: nets that are there already, loaded elsewhere */
    int shapes;    /* dist_shape_create as often, each with dist_shape_set_texture; 0: once, where there is a net */
    int instances; /* dist_scene_create of so many of these shapes */
    const dist_camera *camera; /* dist_tape_create for it and how. The size of a picture without a tape, its planes and
                                  what of it is wanted cost no memory */
    const dist_render_desc *how;
    int cache;     /* dist_cache_create with this resolution; 0: none */
} dist_workspace_desc;
/* The bytes that an arena needs which hands out one piece after another, from an address that is a multiple of 64 and
   each rounded up to one, and takes nothing back: exactly; with one less some create function fails with
   DIST_OUT_OF_MEMORY. The create functions' own code is run without memory. dist_net_load_file needs its file's bytes
   besides, meshes and Chamfer distance theirs.
   0: a create function would refuse (but for what only tensors' numbers and types and those of biases, norms and
   weight_g tell, which are not looked at); desc->context->logger is told why. The table of contents of a model is read
   into memory of desc->context->allocator, or malloc's, and given back: that allocator is not the arena that is still
   to be made. */
DIST_API size_t dist_workspace_bytes(const dist_workspace_desc *desc);

#ifdef __cplusplus
}
#endif

#endif /* DIST_H */

/* ================================================================================================================== */
/* End of the interface. You can stop reading here.                                                                   */
/* ================================================================================================================== */

#ifdef DIST_IMPLEMENTATION
#ifndef DIST_IMPLEMENTED
#define DIST_IMPLEMENTED

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifndef DIST_NO_STDIO
#include <stdio.h>
#endif
#if defined(DIST_NO_SIMD) || !(defined(__x86_64__) || defined(_M_X64) || defined(__aarch64__) || defined(_M_ARM64))
#include <fenv.h> /* the rounding mode, where it stands in no register that is known here */
#endif

/* windows.h makes nothing of these words; the end of this file does so again. */
#ifdef near
#define DISTI_WORDS
#undef near
#undef far
#endif

#ifdef __cplusplus
extern "C" {
#endif

/*@ 01 config, status, hooks ---------------------------------------------------------------------------------------- */

#ifndef DIST_ASSERT
#define DIST_ASSERT(x) ((void)0)
#endif

#if defined(__GNUC__) || defined(__clang__)
#define DISTI_RESTRICT __restrict
#define DISTI_TARGET(isa) __attribute__((target(isa)))
#define DISTI_UNUSED __attribute__((unused))
#define DISTI_INLINE static inline __attribute__((always_inline))
#define DISTI_NOINLINE __attribute__((noinline))
#else
#ifdef _MSC_VER
#define DISTI_RESTRICT __restrict
#define DISTI_NOINLINE __declspec(noinline)
#else
#define DISTI_RESTRICT
#define DISTI_NOINLINE
#endif
#define DISTI_TARGET(isa)
#define DISTI_UNUSED
#define DISTI_INLINE static inline
#endif
/* gcc without optimization makes intrinsics twenty times slower; kernels ask for it themselves. */
#if defined(__GNUC__) && !defined(__clang__) && !defined(__OPTIMIZE__)
#define DISTI_KERNEL __attribute__((optimize("O2")))
#else
#define DISTI_KERNEL
#endif

/* Plain loops that are to become vectors: gcc does that at -O3 only, selects only where no comparison may trap, and
   with -std=c99 multiplies and adds in two instructions. */
#if defined(__GNUC__) && !defined(__clang__)
#define DISTI_LOOPS __attribute__((optimize("O3,no-trapping-math,no-math-errno,fp-contract=fast")))
#else
#define DISTI_LOOPS
#endif

#if !defined(DIST_NO_SIMD) && (defined(__x86_64__) || defined(_M_X64)) &&                                              \
    (defined(__GNUC__) || defined(__clang__) || defined(_MSC_VER))
#define DISTI_X86
#include <immintrin.h>
#if defined(_MSC_VER) && !defined(__clang__)
#include <intrin.h>
#elif defined(_MSC_VER) /* clang-cl's immintrin.h may leave out what its flags do not name */
#include <smmintrin.h>
#include <avxintrin.h>
#include <avx2intrin.h>
#include <fmaintrin.h>
#include <avx512fintrin.h>
#include <avx512bwintrin.h>
#include <avx512dqintrin.h>
#include <avx512vlintrin.h>
#include <avx512vlbwintrin.h>
#include <avx512vldqintrin.h>
#endif
#endif
/* Older compilers do not know the 16-bit instructions. */
#if defined(DISTI_X86) && !defined(DIST_NO_HALF) && !defined(_MSC_VER) &&                                              \
    ((defined(__clang__) && __clang_major__ >= 14) || (!defined(__clang__) && defined(__GNUC__) && __GNUC__ >= 12))
#define DISTI_HALF
#endif
#if !defined(DIST_NO_SIMD) && (defined(__aarch64__) || defined(_M_ARM64))
#define DISTI_NEON
#include <arm_neon.h>
#endif
#if defined(_OPENMP) && !defined(DIST_NO_OPENMP)
#define DISTI_OPENMP
#endif

#define DISTI_ALIGNMENT 64
#define DISTI_MIN(a, b) ((a) < (b) ? (a) : (b))
#define DISTI_MAX(a, b) ((a) > (b) ? (a) : (b))

DIST_API const char *dist_version(void)
{
    return "0.2.0";
}

/* x as memory holds it: the x87's registers hold more, by which a value may be less or more than itself. */
static float disti_float(float x)
{
#if defined(__FLT_EVAL_METHOD__) && __FLT_EVAL_METHOD__ != 0 && __FLT_EVAL_METHOD__ != 16 /* 16: half floats are */
    volatile float kept = x;
    return kept;
#else
    return x;
#endif
}

/* Looks at the bits: -ffast-math removes a test of the value. */
static int disti_finite(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (bits & 0x7f800000u) != 0x7f800000u;
}

/* Not finite, or above 2^56: a sum of products of such numbers may overflow. */
DISTI_UNUSED static unsigned char disti_is_huge(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (bits & 0x7fffffffu) >= 0x5b800000u;
}

DISTI_UNUSED static float disti_nan(void)
{
    uint32_t bits = 0x7fc00000u;
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

/* Of many: a carry out of the exponent's bits says that one is all ones. */
DISTI_UNUSED DISTI_LOOPS static int disti_finite_many(size_t n, const float *x)
{
    uint32_t carry = 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t bits;
        memcpy(&bits, x + i, sizeof bits);
        carry |= (bits & 0x7f800000u) + 0x00800000u;
    }
    return !(carry >> 31);
}

DISTI_UNUSED static int disti_finite_all(size_t n, const float *x)
{
    if (n > 16) return disti_finite_many(n, x);
    for (size_t i = 0; i < n; i++)
        if (!disti_finite(x[i])) return 0;
    return 1;
}

static int disti_finite_double(double x)
{
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return (bits & 0x7ff0000000000000u) != 0x7ff0000000000000u;
}

/* Not of what is not finite, which it does not compare: that would raise a floating-point exception. */
static int disti_between(float x, float low, float high)
{
    return disti_finite(x) && x > low && x < high;
}

/* Beyond float's range its largest number. */
static float disti_within_float(double x)
{
    const double most = 3.4e38;
    return (float)DISTI_MIN(DISTI_MAX(x, -most), most);
}

/* *to += x within float's range; what is not finite adds nothing. */
static void disti_add_within(float *to, double x)
{
    double sum = (double)*to + x;
    if (disti_finite_double(sum)) *to = disti_within_float(sum);
}

/* *out = a * b or a + b; returns 0 and leaves SIZE_MAX if that does not fit. */
static int disti_size_mul(size_t a, size_t b, size_t *out)
{
    if (b != 0 && a > (size_t)-1 / b) {
        *out = (size_t)-1;
        return 0;
    }
    *out = a * b;
    return 1;
}

static int disti_size_add(size_t a, size_t b, size_t *out)
{
    if (a > (size_t)-1 - b) {
        *out = (size_t)-1;
        return 0;
    }
    *out = a + b;
    return 1;
}

#ifndef DIST_NO_LIBC_ALLOC
/* malloc with alignment: the offset to the block's start stands in the byte before the pointer. */
static void *disti_libc_alloc(void *user, size_t bytes, size_t alignment)
{
    (void)user;
    size_t total;
    if (!disti_size_add(bytes, alignment, &total)) return NULL;
    unsigned char *block = (unsigned char *)malloc(total);
    if (!block) return NULL;
    size_t shift = alignment - ((uintptr_t)block & (alignment - 1)); /* 1 to 64 */
    block[shift - 1] = (unsigned char)shift;
    return block + shift;
}

static void disti_libc_free(void *user, void *pointer, size_t bytes)
{
    (void)user;
    (void)bytes;
    unsigned char *p = (unsigned char *)pointer;
    free(p - p[-1]);
}
#endif

/*@ 02 context ------------------------------------------------------------------------------------------------------ */

struct dist_context {
    dist_allocator allocator;
    dist_scheduler scheduler;
    dist_blas blas;
    dist_logger logger;
    int blas_width;
    int workers;
    int isa;
    dist_status status;
    char message[400];
    const char *function;   /* the public one that was called last, for the sentence */
    const char *path;       /* of the file that is being read or written, for that too */
    int instance;           /* 1 + which one of a new scene's is being looked at, for that too; 0: none */
    unsigned char *scratch; /* workers * DISTI_SCRATCH_BYTES: counters, then the tracer's part */
    unsigned char *lanes;   /* workers * lane_bytes: the field's part; grown by create functions only */
    size_t lane_bytes;      /* of each worker, a multiple of DISTI_ALIGNMENT */
    double *partial;        /* DISTI_SLOTS * partial_size: sums of each slot, added in slot order */
    size_t partial_size;
    float *store;           /* what weight gradients keep of some blocks; of the shape that asked last, store_user */
    size_t store_size;
    const void *store_user;
};

enum {
    DISTI_COUNTER_BYTES = 64,
    DISTI_TRACE_BYTES = 1952 * 1024,
    DISTI_SCRATCH_BYTES = DISTI_COUNTER_BYTES + DISTI_TRACE_BYTES
};
/* Sums that must not depend on the number of threads are kept in this many slots. */
enum { DISTI_SLOTS = 32 };

/* Multiply-adds of the field, for the report; each worker its own. */
typedef struct disti_counter {
    double dense; /* what a net without dead units does */
    double done;
} disti_counter;

/* Appends a whole number. */
static size_t disti_format_whole(char *out, uint64_t value)
{
    char reversed[24];
    size_t count = 0, n = 0;
    do {
        reversed[count++] = (char)('0' + (int)(value % 10u));
        value /= 10u;
    } while (value);
    while (count) out[n++] = reversed[--count];
    return n;
}

/* The first `digits` of x > 0, as a whole number, and the power of ten of the first; the last ones are off by up to two
   units in the last place of x. */
static uint64_t disti_decimal_digits(double x, int digits, int *exponent)
{
    double scale = 1.0;
    *exponent = 0;
    while (x >= 10.0) x /= 10.0, ++*exponent;
    while (x < 1.0) x *= 10.0, --*exponent;
    for (int i = 1; i < digits; i++) scale *= 10.0;
    uint64_t mantissa = (uint64_t)(x * scale + 0.5);
    if (mantissa < (uint64_t)(scale * 10.0)) return mantissa;
    ++*exponent;
    return mantissa / 10u;
}

/* Appends such digits, at most 17, without the zeros at their end. */
static size_t disti_format_digits(char *out, uint64_t mantissa, int digits, int exponent)
{
    char text[17];
    size_t n = 0;
    for (int i = digits - 1; i >= 0; i--) {
        text[i] = (char)('0' + (int)(mantissa % 10u));
        mantissa /= 10u;
    }
    int last = digits - 1;
    while (last > 0 && text[last] == '0') last--;
    int plain = exponent >= -4 && exponent < digits;
    int point = plain ? exponent : 0; /* the digit after which the point stands */
    for (int i = 0; i > point; i--) {
        out[n++] = '0';
        if (i == 0) out[n++] = '.';
    }
    for (int i = 0; i <= last || i <= point; i++) {
        out[n++] = i <= last ? text[i] : '0';
        if (i == point && i < last) out[n++] = '.';
    }
    if (plain || exponent == 0) return n;
    out[n++] = 'e';
    if (exponent < 0) out[n++] = '-';
    return n + disti_format_whole(out + n, (uint64_t)(exponent < 0 ? -exponent : exponent));
}

/* Appends a number as a person writes it: integers plainly, others with `digits` (at most 15) significant ones. */
static size_t disti_format_number(char *out, double x, int digits)
{
    size_t n = 0;
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    if (bits >> 63) {
        out[n++] = '-';
        x = -x;
    }
    if ((bits & 0x7ff0000000000000u) == 0x7ff0000000000000u) {
        memcpy(out + n, (bits & 0xfffffffffffffu) ? "nan" : "inf", 3);
        return n + 3;
    }
    if (x < 1e15 && x == (double)(uint64_t)x) return n + disti_format_whole(out + n, (uint64_t)x);
    int exponent;
    uint64_t mantissa = disti_decimal_digits(x, digits, &exponent);
    return n + disti_format_digits(out + n, mantissa, digits, exponent);
}

/* Appends text, as long as 64 bytes stay free. Unprintable bytes become '?': it may come out of a hostile file. */
static size_t disti_fail_text(char *out, size_t n, size_t size, const char *text)
{
    for (const char *t = text ? text : "(null)"; *t && n + 64 < size; t++)
        out[n++] = *t >= ' ' && *t <= '~' ? *t : '?';
    return n;
}

/* Keeps the sentence of the first failure and returns status. In format %s stands for text, the first and second %d
   for a and b; what is too long is cut. The instance and the file's path, if there are any, come last. */
static dist_status disti_fail(dist_context *ctx, dist_status status, const char *format, const char *text, double a,
                              double b)
{
    if (!ctx) return status;
    char message[sizeof ctx->message];
    size_t n = 0;
    int used = 0;
    for (const char *c = format; *c && n + 64 < sizeof message; c++) {
        if (c[0] == '%' && c[1] == 's') {
            n = disti_fail_text(message, n, sizeof message, text);
            c++;
        } else if (c[0] == '%' && c[1] == 'd') {
            n += disti_format_number(message + n, used++ ? b : a, 6);
            c++;
        } else {
            message[n++] = *c;
        }
    }
    if (ctx->instance > 0) {
        memcpy(message + n, " (instances[", 12);
        n += 12;
        n += disti_format_number(message + n, ctx->instance - 1, 6);
        message[n++] = ']';
        message[n++] = ')';
    }
    if (ctx->path) {
        message[n++] = ' ';
        message[n++] = '(';
        n = disti_fail_text(message, n, sizeof message, ctx->path);
        message[n++] = ')';
    }
    message[n] = 0;
    if (ctx->status == DIST_OK) {
        ctx->status = status;
        memcpy(ctx->message, message, n + 1);
    }
    if (ctx->logger.log_fn) ctx->logger.log_fn(ctx->logger.user, status, message);
    return status;
}

/* disti_fail for an argument, by a sentence without numbers. */
static dist_status disti_refuse(dist_context *ctx, const char *format, const char *text)
{
    return disti_fail(ctx, DIST_BAD_ARGUMENT, format, text, 0, 0);
}

/* A parameter with its range: low, 0 or 1, to high, which means none above 1e38. */
typedef struct disti_limit {
    char name[24];
    double value, low, high;
} disti_limit;

/* More points or rays than any memory holds: a -1 turned size_t, most likely. */
static int disti_count_fits(size_t n)
{
    return n >> 20 >> 19 == 0 && n <= (size_t)-1 / (3 * sizeof(float)); /* 32 bits have no >> 39 */
}

static dist_status disti_count_check(dist_context *ctx, size_t n, const char *function)
{
    if (disti_count_fits(n)) return DIST_OK;
    return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: n is %d, more than memory can hold", function, (double)n, 0);
}

/* Refuses the first that is out of its range or not finite. */
static dist_status disti_limits(dist_context *ctx, const char *function, size_t count, const disti_limit *limits)
{
    for (; count > 0; count--, limits++) {
        char text[96];
        size_t n = strlen(function);
        double x = limits->value;
        if (disti_finite_double(x) && x >= limits->low && x <= limits->high) continue;
        memcpy(text, function, n);
        memcpy(text + n, ": ", 2);
        memcpy(text + n + 2, limits->name, strlen(limits->name) + 1);
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          limits->high > 1e38  ? "%s is %d, must be 0 or more, below 3e38"
                          : limits->low > 0.0 ? "%s is %d, must be 1 to %d"
                                              : "%s is %d, must be 0 to %d",
                          text, x, limits->high);
    }
    return DIST_OK;
}

static int disti_is_aligned(const void *p) { return (uintptr_t)p % DISTI_ALIGNMENT == 0; }

/* NULL, after disti_fail, where the allocator refuses, ignores the alignment, or bytes is SIZE_MAX (the mark of an
   overflow). */
static void *disti_alloc_from(dist_context *ctx, const dist_allocator *from, size_t bytes)
{
    if (bytes == 0) bytes = DISTI_ALIGNMENT;
    void *p = bytes == (size_t)-1 ? NULL : from->alloc_fn(from->user, bytes, DISTI_ALIGNMENT);
    if (!p) disti_fail(ctx, DIST_OUT_OF_MEMORY, "%s: out of memory: %d bytes were asked for", ctx->function,
                       (double)bytes, 0);
    if (disti_is_aligned(p)) return p;
    from->free_fn(from->user, p, bytes);
    disti_fail(ctx, DIST_OUT_OF_MEMORY, "%s: allocator.alloc_fn gave %d bytes that are not aligned to %d",
               ctx->function, (double)bytes, DISTI_ALIGNMENT);
    return NULL;
}

static void *disti_alloc(dist_context *ctx, size_t bytes) { return disti_alloc_from(ctx, &ctx->allocator, bytes); }

/* Room for count things of `each` bytes. */
static void *disti_alloc_array(dist_context *ctx, size_t count, size_t each)
{
    size_t bytes;
    disti_size_mul(count, each, &bytes);
    return disti_alloc(ctx, bytes);
}

/* bytes as given to disti_alloc; p may be NULL. */
static void disti_free(dist_context *ctx, void *p, size_t bytes)
{
    if (p) ctx->allocator.free_fn(ctx->allocator.user, p, bytes == 0 ? (size_t)DISTI_ALIGNMENT : bytes);
}

#ifdef DISTI_X86
/* r: eax, ebx, ecx, edx */
static void disti_cpuid(unsigned leaf, unsigned sub, unsigned r[4])
{
#if defined(_MSC_VER) && !defined(__clang__)
    int v[4];
    __cpuidex(v, (int)leaf, (int)sub);
    for (int i = 0; i < 4; i++) r[i] = (unsigned)v[i];
#else
    __asm__ volatile("cpuid" : "=a"(r[0]), "=b"(r[1]), "=c"(r[2]), "=d"(r[3]) : "a"(leaf), "c"(sub));
#endif
}

/* The registers that the operating system saves: bits 1 and 2 for ymm, 5 to 7 for zmm and the masks. */
static unsigned disti_xgetbv(void)
{
#if defined(_MSC_VER) && !defined(__clang__)
    return (unsigned)_xgetbv(0);
#else
    unsigned low, high;
    __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0u));
    return low;
#endif
}
#endif

/* Whether this processor, its operating system and this build have DIST_ISA_*. */
static int disti_cpu_has(int isa)
{
    if (isa == DIST_ISA_SCALAR) return 1;
#ifdef DISTI_NEON
    if (isa == DIST_ISA_NEON) return 1;
#endif
#ifdef DISTI_X86
    if (isa == DIST_ISA_SSE2) return 1; /* every x86-64 */
    if (isa == DIST_ISA_AVX2 || isa == DIST_ISA_AVX512) {
        const unsigned fma_osxsave_avx = 1u << 12 | 1u << 27 | 1u << 28;
        const unsigned avx2 = 1u << 5;
        const unsigned avx512 = avx2 | 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31; /* F, DQ, BW, VL */
        const unsigned features = isa == DIST_ISA_AVX2 ? avx2 : avx512;
        const unsigned state = isa == DIST_ISA_AVX2 ? 0x06u : 0xe6u;
        unsigned r[4];
        disti_cpuid(0, 0, r);
        if (r[0] < 7) return 0;
        disti_cpuid(1, 0, r);
        if ((r[2] & fma_osxsave_avx) != fma_osxsave_avx) return 0; /* without OSXSAVE xgetbv itself would fault */
        if ((disti_xgetbv() & state) != state) return 0;
        disti_cpuid(7, 0, r);
        return (r[1] & features) == features;
    }
#endif
    return 0;
}

/* Whether this processor and this build compute in DIST_HALF_F16 or DIST_HALF_BF16. */
static int disti_cpu_half(int kind)
{
#ifdef DISTI_HALF
    unsigned r[4];
    if (!disti_cpu_has(DIST_ISA_AVX512)) return 0;
    disti_cpuid(7, 0, r);
    if (kind == DIST_HALF_F16) return (int)(r[3] >> 23 & 1);
    if (r[0] < 1) return 0;
    disti_cpuid(7, 1, r);
    return kind == DIST_HALF_BF16 && (r[0] >> 5 & 1);
#else
    return (void)kind, 0;
#endif
}

static int disti_cpu_best(void)
{
    int isa = DIST_ISA_NEON; /* the later the better, down to scalar */
    while (!disti_cpu_has(isa)) isa--;
    return isa;
}

DIST_API const char *dist_isa_name(int isa)
{
    const char *const names[] = {"auto", "scalar", "sse2", "avx2", "avx512", "neon"};
    return names[isa >= DIST_ISA_AUTO && isa <= DIST_ISA_NEON ? isa : DIST_ISA_AUTO];
}

#if defined(DISTI_X86)
/* The caller's floating-point state may trap, round elsewhere or flush; work runs in the default state with denormals
   flushed (they cost a hundred times a normal number and carry nothing here), and the caller's comes back after it. */
static unsigned disti_float_state_enter(void)
{
    unsigned state = _mm_getcsr();
    _mm_setcsr(0x9fc0u); /* all exceptions masked, round to nearest, flush to zero, denormals are zero */
    return state;
}

static void disti_float_state_leave(unsigned state)
{
    _mm_setcsr(state);
}
#elif defined(DISTI_NEON) && (defined(__GNUC__) || defined(__clang__))
static unsigned disti_float_state_enter(void)
{
    uint64_t state;
    uint64_t ours = 1u << 24; /* flush to zero, round to nearest, no traps */
    __asm__ volatile("mrs %0, fpcr" : "=r"(state));
    __asm__ volatile("msr fpcr, %0" : : "r"(ours));
    return (unsigned)state;
}

static void disti_float_state_leave(unsigned state)
{
    uint64_t theirs = state;
    __asm__ volatile("msr fpcr, %0" : : "r"(theirs));
}
#elif defined(FE_TONEAREST)
/* Elsewhere C sees to the rounding, which is what results depend on. */
static unsigned disti_float_state_enter(void)
{
    int state = fegetround();
    if (state != FE_TONEAREST) fesetround(FE_TONEAREST);
    return (unsigned)state;
}

static void disti_float_state_leave(unsigned state)
{
    if ((int)state != FE_TONEAREST) fesetround((int)state);
}
#else
static unsigned disti_float_state_enter(void) { return 0; }
static void disti_float_state_leave(unsigned state) { (void)state; }
#endif

typedef struct disti_job {
    dist_task_fn fn;
    void *arg;
} disti_job;

static void disti_job_task(void *arg, int index, int worker)
{
    const disti_job *job = (const disti_job *)arg;
    unsigned state = disti_float_state_enter();
    job->fn(job->arg, index, worker);
    disti_float_state_leave(state);
}

/* The only door to parallelism: fn(arg, index, worker) for index 0..count-1, worker below ctx->workers. */
static void disti_run(dist_context *ctx, int count, dist_task_fn fn, void *arg)
{
    disti_job job = {fn, arg};
    if (count <= 0) return;
    if (ctx->scheduler.run_fn) {
        ctx->scheduler.run_fn(ctx->scheduler.user, count, disti_job_task, &job);
        return;
    }
#ifdef DISTI_OPENMP
    if (ctx->workers > 1 && count > 1) {
        int next = 0, team = 0;
#pragma omp parallel num_threads(ctx->workers)
        {
            int worker, index;
#pragma omp critical(dist_run)
            worker = team++;
            for (;;) {
#pragma omp critical(dist_run)
                index = next++;
                if (index >= count) break;
                disti_job_task(&job, index, worker);
            }
        }
        return;
    }
#endif
    for (int index = 0; index < count; index++) disti_job_task(&job, index, 0);
}

static int disti_default_workers(void)
{
    int team = 1;
#ifdef DISTI_OPENMP
    team = 0;
#pragma omp parallel
    {
#pragma omp critical(dist_run)
        team++;
    }
#endif
    return team;
}

/* At the door of public functions with a context; out of memory tells the last one's name. A context that could not be
   made refuses everything. */
static dist_status disti_enter(dist_context *ctx, const char *function)
{
    if (!ctx) return DIST_BAD_ARGUMENT;
    ctx->function = function;
    return ctx->workers > 0 ? DIST_OK : ctx->status;
}

/* n to the next multiple of `to`, a power of two; SIZE_MAX, the mark of what does not fit, where there is none. */
static size_t disti_round_up(size_t n, size_t to)
{
    return n > (size_t)-1 - to ? (size_t)-1 : (n + to - 1) & ~(to - 1);
}

/* Makes each worker's lane at least `bytes`. The contents do not survive: create functions only. */
static dist_status disti_lanes_reserve(dist_context *ctx, size_t bytes)
{
    if (bytes <= ctx->lane_bytes) return DIST_OK;
    size_t each = disti_round_up(bytes, DISTI_ALIGNMENT);
    unsigned char *lanes = (unsigned char *)disti_alloc_array(ctx, (size_t)ctx->workers, each);
    if (!lanes) return DIST_OUT_OF_MEMORY;
    disti_free(ctx, ctx->lanes, ctx->lane_bytes * (size_t)ctx->workers);
    ctx->lanes = lanes;
    ctx->lane_bytes = each;
    return DIST_OK;
}

static unsigned char *disti_scratch(const dist_context *ctx, int worker)
{
    return ctx->scratch + (size_t)DISTI_SCRATCH_BYTES * (size_t)worker;
}

static unsigned char *disti_lane(const dist_context *ctx, int worker)
{
    return ctx->lanes + ctx->lane_bytes * (size_t)worker;
}

/* The next `count` things of `size` bytes in a block of memory; base NULL: only *at moves on. */
static void *disti_take(unsigned char *base, size_t *at, size_t count, size_t size)
{
    unsigned char *p = base ? base + *at : NULL;
    *at += disti_round_up(count * size, DISTI_ALIGNMENT);
    return p;
}

/* splitmix64: the same numbers everywhere for one seed. */
DISTI_UNUSED static uint64_t disti_random_bits(uint64_t *state)
{
    uint64_t z = *state += 0x9e3779b97f4a7c15u;
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

/* Uniform in [0, 1). */
DISTI_UNUSED static double disti_random_unit(uint64_t *state)
{
    return (double)(disti_random_bits(state) >> 11) * (1.0 / 9007199254740992.0);
}

static disti_counter *disti_counter_of(const dist_context *ctx, int worker)
{
    return (disti_counter *)(void *)disti_scratch(ctx, worker);
}

static dist_status disti_partial_reserve(dist_context *ctx, size_t size)
{
    if (size <= ctx->partial_size) return DIST_OK;
    double *partial = (double *)disti_alloc_array(ctx, size, DISTI_SLOTS * sizeof(double));
    if (!partial) return DIST_OUT_OF_MEMORY;
    disti_free(ctx, ctx->partial, ctx->partial_size * DISTI_SLOTS * sizeof(double));
    ctx->partial = partial;
    ctx->partial_size = size;
    return DIST_OK;
}

/* For the sums of a gradient for `codes` numbers, and one more for what a piece leaves over. */
static dist_status disti_partial_for(dist_context *ctx, size_t codes)
{
    size_t size;
    disti_size_add(codes, codes / DISTI_SLOTS + 1, &size);
    return disti_partial_reserve(ctx, size);
}

#ifndef DIST_NO_TRAIN
static dist_status disti_store_reserve(dist_context *ctx, size_t size)
{
    if (size <= ctx->store_size) return DIST_OK;
    float *store = (float *)disti_alloc_array(ctx, size, sizeof(float));
    if (!store) return DIST_OUT_OF_MEMORY;
    disti_free(ctx, ctx->store, ctx->store_size * sizeof(float));
    ctx->store = store;
    ctx->store_size = size;
    ctx->store_user = NULL;
    return DIST_OK;
}
#endif

/* C (3, 4) = 2 A B + 3 C in all four transpositions, against plain loops; small integers, so every right BLAS is
   exact. */
static int disti_blas_works(const dist_blas *blas)
{
    for (int mode = 0; mode < 4; mode++) {
        float a[5 * 7], b[5 * 7], c[3 * 6], expected[3 * 6];
        int ta = mode & 1, tb = mode >> 1;
        for (int i = 0; i < 35; i++) {
            a[i] = (float)((i * 7 + 3) % 11 - 5);
            b[i] = (float)((i * 5 + 1) % 13 - 6);
        }
        for (int i = 0; i < 18; i++) c[i] = expected[i] = (float)(i % 4);
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 4; j++) {
                float sum = 0.0f;
                for (int k = 0; k < 5; k++)
                    sum += (ta ? a[k * 7 + i] : a[i * 7 + k]) * (tb ? b[j * 7 + k] : b[k * 7 + j]);
                expected[i * 6 + j] = 2.0f * sum + 3.0f * expected[i * 6 + j];
            }
        }
        blas->sgemm_fn(blas->user, ta, tb, 3, 4, 5, 2.0f, a, 7, b, 7, 3.0f, c, 6);
        if (memcmp(c, expected, sizeof c) != 0) return 0;
    }
    return 1;
}

enum { DISTI_TRIALS = 64 };

typedef struct disti_trial {
    int workers;
    volatile unsigned char wrong, done[DISTI_TRIALS];
} disti_trial;

static void disti_trial_task(void *arg, int index, int worker)
{
    disti_trial *trial = (disti_trial *)arg;
    if (index < 0 || index >= DISTI_TRIALS || worker < 0 || worker >= trial->workers) trial->wrong = 1;
    else trial->done[index] = (unsigned char)(trial->done[index] + 1);
}

/* Every index once, by a worker there is. */
static int disti_scheduler_works(const dist_scheduler *scheduler, int workers)
{
    disti_trial trial;
    trial.workers = workers;
    trial.wrong = 0;
    for (int i = 0; i < DISTI_TRIALS; i++) trial.done[i] = 0;
    scheduler->run_fn(scheduler->user, DISTI_TRIALS, disti_trial_task, &trial);
    for (int i = 0; i < DISTI_TRIALS; i++)
        if (trial.done[i] != 1) return 0;
    return !trial.wrong;
}

/* What is wrong with desc, as a status with its sentence. */
static dist_status disti_context_check(dist_context *ctx, const dist_context_desc *desc)
{
    const char *name = "dist_context_create";
    if (desc->workers < 0 || desc->workers > 1024)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: workers is %d, must be 0 to 1024", name, desc->workers, 0);
    if (desc->isa < DIST_ISA_AUTO || desc->isa > DIST_ISA_NEON)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: isa is %d, must be a DIST_ISA_ constant", name, desc->isa, 0);
    if (desc->isa != DIST_ISA_AUTO && !disti_cpu_has(desc->isa))
        return disti_fail(ctx, DIST_UNSUPPORTED, "dist_context_create: this processor or this build has no %s",
                          dist_isa_name(desc->isa), 0, 0);
    if (desc->scheduler.run_fn && desc->workers == 0)
        return disti_refuse(ctx, "%s: workers is 0, must be told with a scheduler", name);
    if (desc->scheduler.run_fn && !disti_scheduler_works(&desc->scheduler, desc->workers))
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "%s: scheduler.run_fn fails its self-test: each index from 0 to count - 1 once, by a worker "
                          "from 0 to %d", name, desc->workers - 1, 0);
    if (desc->blas_width < 0)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: blas_width is %d, must not be negative", name, desc->blas_width,
                          0);
    if (desc->blas.sgemm_fn && !disti_blas_works(&desc->blas))
        return disti_fail(
            ctx, DIST_BAD_ARGUMENT,
            "%s: blas.sgemm_fn fails its self-test: C = alpha op(A) op(B) + beta C, row-major, gives wrong numbers",
            name, 0, 0);
    return DIST_OK;
}

/* All of dist_context_create but the memory of ctx itself. DIST_OUT_OF_MEMORY: nothing is held; after any other failure
   the context refuses everything. */
DIST_API dist_context_desc dist_context_desc_resolve(const dist_context_desc *desc)
{
    dist_context_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.blas_width == 0) d.blas_width = 192;
    if (d.isa == DIST_ISA_AUTO) d.isa = disti_cpu_best();
    if (d.workers == 0) d.workers = disti_default_workers();
#ifndef DISTI_OPENMP
    if (!d.scheduler.run_fn) d.workers = 1;
#endif
    return d;
}

static dist_status disti_context_begin(dist_context *ctx, const dist_context_desc *desc,
                                       const dist_allocator *allocator)
{
    memset(ctx, 0, sizeof *ctx);
    ctx->allocator = *allocator;
    ctx->logger = desc->logger;
    ctx->function = "dist_context_create";
    dist_status status = disti_context_check(ctx, desc);
    if (status != DIST_OK) return status;
    dist_context_desc d = dist_context_desc_resolve(desc);
    ctx->scheduler = d.scheduler;
    ctx->blas = d.blas;
    ctx->blas_width = d.blas_width;
    ctx->isa = d.isa;
    ctx->workers = d.workers;
    ctx->scratch = (unsigned char *)disti_alloc_array(ctx, (size_t)ctx->workers, DISTI_SCRATCH_BYTES);
    return ctx->scratch ? DIST_OK : DIST_OUT_OF_MEMORY;
}

/* desc's allocator, or malloc's. 0: only half of one, or none and no malloc. */
static int disti_allocator_of(const dist_context_desc *desc, dist_allocator *allocator)
{
    *allocator = desc->allocator;
    if (!allocator->alloc_fn != !allocator->free_fn) return 0;
    if (allocator->alloc_fn) return 1;
#ifdef DIST_NO_LIBC_ALLOC
    return 0;
#else
    allocator->alloc_fn = disti_libc_alloc;
    allocator->free_fn = disti_libc_free;
    return 1;
#endif
}

/* Without a context to keep the sentence, the logger alone is told. */
static dist_context *disti_no_context(const dist_context_desc *desc, dist_status status, const char *message)
{
    if (desc->logger.log_fn) desc->logger.log_fn(desc->logger.user, status, message);
    return NULL;
}

DIST_API dist_context *dist_context_create(const dist_context_desc *desc)
{
    dist_context_desc d;
    dist_allocator allocator;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (!disti_allocator_of(&d, &allocator))
        return disti_no_context(&d, DIST_BAD_ARGUMENT,
                                "dist_context_create: allocator.alloc_fn or free_fn is NULL, must be both or, where "
                                "this build has malloc, none");
    dist_context *ctx = (dist_context *)allocator.alloc_fn(allocator.user, sizeof(dist_context), DISTI_ALIGNMENT);
    if (!ctx) return disti_no_context(&d, DIST_OUT_OF_MEMORY, "dist_context_create: out of memory");
    int aligned = disti_is_aligned(ctx);
    if (aligned && disti_context_begin(ctx, &d, &allocator) != DIST_OUT_OF_MEMORY) {
        for (int worker = 0; ctx->scratch && worker < ctx->workers; worker++)
            memset(disti_counter_of(ctx, worker), 0, sizeof(disti_counter));
        return ctx;
    }
    allocator.free_fn(allocator.user, ctx, sizeof *ctx);
    if (aligned) return NULL; /* the logger knows */
    return disti_no_context(&d, DIST_OUT_OF_MEMORY, "dist_context_create: what alloc_fn returned is not aligned");
}

DIST_API void dist_context_destroy(dist_context *ctx)
{
    if (!ctx) return;
    disti_free(ctx, ctx->store, ctx->store_size * sizeof(float));
    disti_free(ctx, ctx->partial, ctx->partial_size * DISTI_SLOTS * sizeof(double));
    disti_free(ctx, ctx->lanes, ctx->lane_bytes * (size_t)ctx->workers);
    disti_free(ctx, ctx->scratch, (size_t)DISTI_SCRATCH_BYTES * (size_t)ctx->workers);
    disti_free(ctx, ctx, sizeof *ctx);
}

DIST_API dist_status dist_context_status(const dist_context *ctx)
{
    return ctx ? ctx->status : DIST_BAD_ARGUMENT;
}

DIST_API const char *dist_context_message(const dist_context *ctx)
{
    return ctx ? ctx->message : "no context: dist_context_create returned NULL";
}

DIST_API void dist_context_clear(dist_context *ctx)
{
    if (!ctx || ctx->workers == 0) return;
    ctx->status = DIST_OK;
    ctx->message[0] = 0;
}

DIST_API int dist_context_isa(const dist_context *ctx)
{
    return ctx ? ctx->isa : DIST_ISA_AUTO;
}

DIST_API int dist_context_workers(const dist_context *ctx)
{
    return ctx ? ctx->workers : 0;
}

/*@ 03 kernels ------------------------------------------------------------------------------------------------------ */

/* Points stand in the lanes: activations of a block of DISTI_BLOCK points are rows [unit][DISTI_BLOCK], and a layer's
   weights are packed in panels of eight outputs, element (o, k) at ((o / 8) * rows + k) * 8 + o % 8, so that one
   broadcast serves a whole row. Nothing is ever transposed on the way forward; the reverse pass reads the same
   packing. */
enum { DISTI_BLOCK = 48 };

/* forward   y[o][c] = bias[o] + sum_k weights(o, k) x[k][c]     k ascending over alive[0..alive_count-1], or all rows
             with relu or mask: y = max(0, y), which leaves NaN; bit c of mask[o] = y[o][c] > 0, or NaN
   Leaving out rows that are zero for the whole block changes no bit of the result.
   All matrices are 64-byte aligned; y, bias and mask hold `out` rounded up to a multiple of 8; columns beyond `columns`
   may be computed from what stands there, up to DISTI_BLOCK, but their mask bits are 0. */
typedef struct disti_gemm {
    const float *weights;
    const float *bias;
    const float *x;
    float *y;
    const int *alive; /* NULL: all rows */
    uint64_t *mask;   /* NULL: not asked for */
    int rows, alive_count, out, columns, relu;
} disti_gemm;

/* backward  d_x[k][c] = (bit c of mask[k]) * sum_o weights(o, k) d_y[o][c]     o ascending over alive_out, k listed
   NULL lists: all; NULL mask: all ones. Rows of d_x that are not listed are not written. */
typedef struct disti_gemm_back {
    const float *weights;
    const float *d_y;
    float *d_x;
    const int *alive_out, *alive_rows;
    const uint64_t *mask;
    int rows, out, alive_out_count, alive_rows_count, columns;
} disti_gemm_back;

/* weights   d_weights[o * stride + k] += sum_c d_y[o][c] xt[c * xt_stride + k]      o < out, k < rows, c < columns
   xt is the block's input transposed, (columns, xt_stride), xt_stride a multiple of 16; d_weights has no alignment. */
typedef struct disti_gemm_weights {
    const float *d_y;
    const float *xt;
    float *d_weights;
    size_t stride, xt_stride;
    int out, rows, columns;
} disti_gemm_weights;

/* Few points: y[c][o] = bias[o] + sum_k weights(o, k) x[c][k], gemm's bits, over the rows listed in ascending order,
   with relu no less than 0; then sum[o] = that of y[.][o], 0 only where all are. Without bias from c = biased on, which
   is DISTI_FEW_LANES or, of tangents, less. bias, y and sum are written or read up to out rounded up to 8. */
enum { DISTI_FEW_POINTS = 12, DISTI_FEW_LANES = 16 };
typedef struct disti_few {
    const float *weights, *bias, *x; /* x (points, stride) */
    const int *list;
    float *y, *sum; /* y (points, stride) */
    size_t stride;
    int rows, count, out, points, relu, biased;
} disti_few;

/* Of least to most points, `points` go first by themselves: gemm takes whole vectors of points. */
typedef struct disti_part {
    int least, most, points;
} disti_part;

enum { DISTI_CELL_POINTS = 12, DISTI_CELLS = DISTI_BLOCK / DISTI_CELL_POINTS }; /* neighbors, and their boxes */

/* Of each block, sums over the rows listed, for every output o: sum[0..3][o] = sum_i weights(o, list[i]) model[i][0..3]
   and sum[4][o] = sum_i |weights(o, list[i])| model[i][4]; stride is at least out rounded up to 8. */
typedef struct disti_bound {
    const float *weights;
    const int *list;    /* (blocks, list_stride) */
    const int *count;   /* (blocks): of list */
    const float *model; /* (blocks, stride, 8) */
    float *sum;         /* (blocks, 5, stride) */
    size_t stride, list_stride;
    int rows, out, blocks;
} disti_bound;

/* The model of the rows listed of one block: with slope = sum[1..3][row], or half of that where a lane of the row is
   dead, model[i] = m, slope, e where |x[row] - (m + slope . d)| <= e over the lanes, rounding (slack) included. */
typedef struct disti_fit {
    const int *list;
    const float *x, *d; /* (., B), (3, B) */
    const float *sum;   /* (5, stride) */
    const uint64_t *mask;
    float *model;       /* (count, 8) */
    size_t stride;
    float half[3], slack; /* |d| <= half */
    int count, columns; /* columns: a multiple of 16 */
} disti_fit;

typedef struct disti_kernels {
    void (*gemm)(const disti_gemm *g);
    /* gemm's bits of the `count` outputs listed alone, with ReLU and mask, whose other rows become 0 */
    void (*gemm_some)(const disti_gemm *g, const int *list, int count);
    void (*few)(const disti_few *g);
    int few_points;  /* up to so many points `few` is the faster */
    int lone_points; /* up to so many `few` with their tangents is faster than a reverse pass: disti_few_gradient */
    const disti_part *parts; /* NULL: none; in ascending order up to one whose least is 0 */
    void (*bound)(const disti_bound *g);
    /* live[o]: 0 where sum[0][o] + sum[4][o] + bias[o] + slack |bias[o]| + the largest of sum[1..3][o] . c
       + |sum[1..3][o]| . h over DISTI_CELLS boxes (center c, half extents h) is below 0 and finite, else 1 */
    void (*live)(size_t out, const float *sum, size_t stride, const float *bias, float slack, const float *cell,
                 int *live);
    void (*fit)(const disti_fit *g);
    void (*gemm_back)(const disti_gemm_back *g);
    void (*gemm_weights)(const disti_gemm_weights *g);
    /* y[c] = bias + sum_k w[k] x[k][c], c < DISTI_BLOCK, over alive rows (NULL: all): the last layer's single output */
    void (*dot)(const float *w, float bias, const float *x, const int *alive, int alive_count, int rows, int columns,
                float *y);
    /* y[k][c] = (bit c of mask[k]) * w[k] s[c] for the listed rows (NULL: all): its adjoint */
    void (*outer)(const float *w, const float *s, const int *alive, int alive_count, int rows, int columns,
                  const uint64_t *mask, float *y);
    /* sum[k][c % 16] += s[c] x[k][c] for the listed rows, c < columns: a row's sum in sixteen parts (vectors:
       other parts) */
    void (*lanes)(const float *s, const float *x, const int *alive, int alive_count, int rows, int columns, float *sum);
    /* points (B, 3) to rows (3, B), and back */
    void (*rows)(const float *points, float *rows);
    void (*points)(const float *rows, float *points);
    /* a coordinate's rows of the encoding: disti_angles */
    void (*angles)(double base, int levels, const float *x, size_t stride, float *sines, float *cosines);
    /* y <- y + s x in double */
    void (*axpy)(size_t n, double s, const float *x, double *y);
    /* y <- max(0, y) and the bits of the positive lanes of each row */
    void (*relu)(size_t rows, float *y, uint64_t *mask);
    /* y <- activation(y), n values; slope (n) gets its derivative unless NULL */
    void (*activate)(int activation, float scale, size_t n, float *y, float *slope);
    /* its adjoint of n rows, in place: disti_activate_backward */
    void (*activate_back)(size_t n, size_t half, const float *slope, float *d);
    /* LayerNorm of a block: disti_norm_lanes over all lanes; of few points: disti_norm_points */
    void (*norm)(int units, float epsilon, const float *gamma, const float *beta, float *x, float *hat, float *inverse);
    void (*norm_few)(int units, int points, size_t stride, float epsilon, const float *gamma, const float *beta,
                     const float *x, float *hat, float *y);
    void (*norm_back)(int units, const float *gamma, size_t half, const float *hat, const float *inverse, float *d);
    /* of values in the first half of the lanes and tangents in the second: disti_norm_tangent_lanes, and of n rows
       disti_activate_tangents */
    void (*norm_tangents)(int units, float epsilon, const float *gamma, const float *beta, float *x, float *hat,
                          float *inverse);
    void (*activate_tangents)(int activation, float scale, size_t n, float *y, float *slope, uint64_t *mask);
    int (*huge)(size_t n, const float *x); /* whether disti_is_huge of any */
    /* to[c][k] = scale rows[k][c], k < 16, c < B */
    void (*transpose)(const float *const *rows, float scale, float *to, size_t stride);
} disti_kernels;

/* The scalar kernels are the definition; the others are measured against them. They hold two rows of four sums, or
   eight, in variables of their own, which the registers of any processor have room for: in memory, each would be loaded
   and stored again with each of its terms. */
#define DISTI_FOUR(M) M(0) M(1) M(2) M(3)

/* y[o] and y[p] */
static void disti_gemm_rows(const disti_gemm *g, int o, int p)
{
    const int count = g->alive ? g->alive_count : g->rows, both[2] = {o, p};
    const float *w0 = g->weights + (size_t)(o / 8) * (size_t)g->rows * 8 + o % 8;
    const float *w1 = g->weights + (size_t)(p / 8) * (size_t)g->rows * 8 + p % 8;
    float *y0 = g->y + (size_t)o * DISTI_BLOCK, *y1 = g->y + (size_t)p * DISTI_BLOCK;
    for (int c = 0; c < g->columns; c += 4) {
#define DISTI_BEGIN(j) float a##j = g->bias[o], b##j = g->bias[p];
#define DISTI_TERM(j) a##j += a * x[j]; b##j += b * x[j];
#define DISTI_END(j) y0[c + j] = a##j; y1[c + j] = b##j;
        DISTI_FOUR(DISTI_BEGIN)
        for (int i = 0; i < count; i++) {
            const size_t k = (size_t)(g->alive ? g->alive[i] : i);
            const float *x = g->x + k * DISTI_BLOCK + c, a = w0[k * 8], b = w1[k * 8];
            DISTI_FOUR(DISTI_TERM)
        }
        DISTI_FOUR(DISTI_END)
#undef DISTI_BEGIN
#undef DISTI_TERM
#undef DISTI_END
    }
    for (int r = 0; r < 2; r++) {
        float *y = g->y + (size_t)both[r] * DISTI_BLOCK;
        uint64_t bits = 0;
        for (int c = 0; c < g->columns; c++) {
            y[c] += 0.0f; /* minus zero becomes zero, so that a zero row left out cannot show in its sign */
            if (!g->mask && !g->relu) continue;
            if (y[c] <= 0.0f) y[c] = 0.0f;
            else bits |= (uint64_t)1 << c;
        }
        if (g->mask) g->mask[both[r]] = bits;
    }
}

static void disti_gemm_scalar(const disti_gemm *g)
{
    for (int o = 0; o < (g->out + 7) / 8 * 8; o += 2) disti_gemm_rows(g, o, o + 1);
}

static void disti_gemm_some_scalar(const disti_gemm *g, const int *list, int count)
{
    memset(g->mask, 0, (size_t)g->out * sizeof(uint64_t));
    for (int i = 0; i < count; i += 2) disti_gemm_rows(g, list[i], list[DISTI_MIN(i + 1, count - 1)]);
}

static void disti_gemm_back_scalar(const disti_gemm_back *g)
{
    const int count = g->alive_rows ? g->alive_rows_count : g->rows;
    const int out_count = g->alive_out ? g->alive_out_count : g->out;
    for (int n = 0; n < count; n += 2) {
        const int m = DISTI_MIN(n + 1, count - 1);
        const size_t k[2] = {(size_t)(g->alive_rows ? g->alive_rows[n] : n),
                             (size_t)(g->alive_rows ? g->alive_rows[m] : m)};
        float *d0 = g->d_x + k[0] * DISTI_BLOCK, *d1 = g->d_x + k[1] * DISTI_BLOCK;
        for (int c = 0; c < g->columns; c += 4) {
#define DISTI_BEGIN(j) float a##j = 0.0f, b##j = 0.0f;
#define DISTI_TERM(j) a##j += w[k[0] * 8] * d_y[j]; b##j += w[k[1] * 8] * d_y[j];
#define DISTI_END(j) d0[c + j] = a##j; d1[c + j] = b##j;
            DISTI_FOUR(DISTI_BEGIN)
            for (int i = 0; i < out_count; i++) {
                const size_t o = (size_t)(g->alive_out ? g->alive_out[i] : i);
                const float *w = g->weights + o / 8 * (size_t)g->rows * 8 + o % 8;
                const float *d_y = g->d_y + o * DISTI_BLOCK + c;
                DISTI_FOUR(DISTI_TERM)
            }
            DISTI_FOUR(DISTI_END)
#undef DISTI_BEGIN
#undef DISTI_TERM
#undef DISTI_END
        }
        for (int r = 0; r < 2 && g->mask; r++)
            for (int c = 0; c < g->columns; c++)
                if (!(g->mask[k[r]] >> c & 1)) g->d_x[k[r] * DISTI_BLOCK + (size_t)c] = 0.0f;
    }
}

static void disti_gemm_weights_scalar(const disti_gemm_weights *g)
{
    for (int o = 0; o < g->out; o++) {
        const float *d_y = g->d_y + (size_t)o * DISTI_BLOCK;
        for (int k = 0; k < g->rows; k += 4) {
            float *d_weights = g->d_weights + (size_t)o * g->stride + k;
#define DISTI_BEGIN(j) float a##j = 0.0f;
#define DISTI_TERM(j) a##j += d_y[c] * x[j];
#define DISTI_END(j) if (k + j < g->rows) d_weights[j] += a##j;
            DISTI_FOUR(DISTI_BEGIN)
            for (int c = 0; c < g->columns; c++) {
                const float *x = g->xt + (size_t)c * g->xt_stride + k;
                DISTI_FOUR(DISTI_TERM)
            }
            DISTI_FOUR(DISTI_END)
#undef DISTI_BEGIN
#undef DISTI_TERM
#undef DISTI_END
        }
    }
}

static void disti_dot_scalar(const float *w, float bias, const float *x, const int *alive, int alive_count, int rows,
                             int columns, float *y)
{
    const int count = alive ? alive_count : rows;
    for (int c = 0; c < columns; c++) y[c] = bias;
    for (int i = 0; i < count; i++) {
        const size_t k = (size_t)(alive ? alive[i] : i);
        for (int c = 0; c < columns; c++) y[c] += w[k] * x[k * DISTI_BLOCK + (size_t)c];
    }
    for (int c = 0; c < columns; c++) y[c] += 0.0f;
}

static void disti_outer_scalar(const float *w, const float *s, const int *alive, int alive_count, int rows, int columns,
                               const uint64_t *mask, float *y)
{
    const int count = alive ? alive_count : rows;
    for (int i = 0; i < count; i++) {
        const size_t k = (size_t)(alive ? alive[i] : i);
        for (int c = 0; c < columns; c++)
            y[k * DISTI_BLOCK + (size_t)c] = mask && !(mask[k] >> c & 1) ? 0.0f : w[k] * s[c];
    }
}

static void disti_lanes_scalar(const float *s, const float *x, const int *alive, int alive_count, int rows, int columns,
                               float *sum)
{
    const int count = alive ? alive_count : rows;
    for (int i = 0; i < count; i++) {
        const size_t k = (size_t)(alive ? alive[i] : i);
        for (size_t c = 0; c < (size_t)(unsigned)columns; c++) sum[k * 16 + c % 16] += s[c] * x[k * DISTI_BLOCK + c];
    }
}

/* exp to 2 ulp, x in [-87, 88] */
DISTI_INLINE float disti_exp_within(float x)
{
    int32_t k = (int32_t)(x * 1.44269504f + 127.5f); /* 127 + what is rounded, which makes it positive */
    float n = (float)(k - 127);
    float r = x - n * 0.693359375f;
    r += n * 2.12194440e-4f;
    float p = 1.9875691500e-4f;
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * r * r + r + 1.0f;
    uint32_t bits = (uint32_t)k << 23;
    float scale;
    memcpy(&scale, &bits, sizeof scale);
    return p * scale;
}

/* exp(x), as if x were no less than -87 and no more than 88. */
DISTI_INLINE float disti_exp(float x)
{
    x = x < 88.0f ? x : 88.0f; /* also for NaN, which may stand in idle lanes */
    return disti_exp_within(x > -87.0f ? x : -87.0f);
}

/* exp(-|x|), no less than 1.6e-38, which it is for NaN, too */
DISTI_INLINE float disti_exp_falling(float x)
{
    float a = x < 0.0f ? -x : x;
    return disti_exp_within(a < 87.0f ? -a : -87.0f);
}

DISTI_INLINE float disti_tanh(float x)
{
    float s = x * x, e = disti_exp_falling(2.0f * x);
    float inner = x + x * s * ((((-5.70498872745e-3f * s + 2.06390887954e-2f) * s - 5.37397155531e-2f) * s +
                                1.33314422036e-1f) * s - 3.33332819422e-1f);
    float large = (1.0f - e) * (1.0f / (1.0f + e));
    large = x < 0.0f ? -large : large;
    return s >= 0.390625f ? large : inner;
}

DISTI_INLINE float disti_sigmoid(float x)
{
    float e = disti_exp_falling(x);
    return (x < 0.0f ? e : 1.0f) * (1.0f / (1.0f + e));
}

/* Their derivatives, by e = exp(-2 |x|) and exp(-|x|): relatively exact where 1 - tanh^2 would have cancelled to
   nothing. */
DISTI_INLINE float disti_tanh_slope(float x)
{
    float e = disti_exp_falling(2.0f * x), inverse = 1.0f / (1.0f + e);
    return 4.0f * e * inverse * inverse;
}

DISTI_INLINE float disti_sigmoid_slope(float x)
{
    float e = disti_exp_falling(x), inverse = 1.0f / (1.0f + e);
    return e * inverse * inverse;
}

/* log(1 + exp(-|x|)), the smooth part of softplus, by 2 atanh(u / (2 + u)). */
DISTI_INLINE float disti_log1p_exp(float x)
{
    float u = disti_exp_falling(x);
    float s = u / (2.0f + u);
    float q = s * s;
    return 2.0f * s *
           (1.0f +
            q * (1.0f / 3 + q * (1.0f / 5 + q * (1.0f / 7 + q * (1.0f / 9 + q * (1.0f / 11 + q * (1.0f / 13)))))));
}

/* Sine and cosine of a double, range-reduced by multiples of pi / 2 in two parts, to about 1e-16 up to 1e4, so that an
   angle doubled fifteen times keeps a float's digits; to 1e-16 of the angle up to 1e9, of 0 beyond. */
DISTI_INLINE void disti_sincos(double x, double *sine, double *cosine)
{
    x = x > -1e9 ? x : 0.0;
    x = x < 1e9 ? x : 0.0;
    double q = x * 0.63661977236758134308;
    int32_t k = (int32_t)(q < 0 ? q - 0.5 : q + 0.5);
    double r = (x - (double)k * 1.57079632673412561417) - (double)k * 6.07710050650619224932e-11;
    double s = r * r;
    double sn = r + r * s *
                        (-1.66666666666666324348e-1 +
                         s * (8.33333333332248946124e-3 +
                              s * (-1.98412698298579493134e-4 +
                                   s * (2.75573137070700676789e-6 +
                                        s * (-2.50507602534068634195e-8 + s * 1.58969099521155010221e-10)))));
    double cs = 1.0 - s * (0.5 - s * (4.16666666666666019037e-2 - s * (1.38888888888741095749e-3 -
                s * (2.48015872894767294178e-5 - s * (2.75573143513906633035e-7 -
                s * (2.08757232129817482790e-9 - s * 1.13596475577881948265e-11))))));
    double a = (k & 1) ? cs : sn, b = (k & 1) ? sn : cs;
    *sine = (k & 2) ? -a : a;
    *cosine = ((k + 1) & 2) ? -b : b;
}

/* sin(r), |r| <= pi / 2, to 3 ulp and within [-1, 1]: at the ends it is meant 4.5e-8 too small for that. */
DISTI_INLINE float disti_sine_half(float r)
{
    float s = r * r;
    return r + r * s * (((2.6055735e-6f * s - 1.98098008e-4f) * s + 8.33306785e-3f) * s - 1.66666596e-1f);
}

/* (-1)^k v */
DISTI_INLINE float disti_flip(float v, int32_t k)
{
    uint32_t bits;
    memcpy(&bits, &v, sizeof bits);
    bits ^= (uint32_t)k << 31;
    memcpy(&v, &bits, sizeof v);
    return v;
}

/* sin(a) and cos(a) by a = k pi + r: (-1)^k sin(r) and (-1)^k sin(pi / 2 - |r|), with both differences taken in double,
   so that they keep their digits. |a| <= 1e9; 2^29 makes what is rounded positive. */
DISTI_INLINE float disti_sine(double a, float *cosine)
{
    int32_t k = (int32_t)(a * 0.318309886183790671538 + 536870912.5);
    double r = a - (double)(k - 536870912) * 3.14159265346825122834;
    r -= (double)(k - 536870912) * 1.21542010130123844498e-10;
    *cosine = disti_flip(disti_sine_half((float)(1.57079632679489661923 - fabs(r))), k);
    return disti_flip(disti_sine_half((float)r), k);
}

/* activation(x), of NaN NaN, *slope gets its derivative, which is finite. scale: softplus's beta, sine's omega. */
DISTI_INLINE float disti_activate_one(int activation, float scale, float x, float *slope)
{
    float v = x, d = 1.0f;
    switch (activation) {
    case DIST_ACTIVATION_RELU:
        d = x <= 0.0f ? 0.0f : 1.0f;
        v = x <= 0.0f ? 0.0f : x;
        break;
    case DIST_ACTIVATION_ELU: {
        float near_zero = x * (1.0f + x * (0.5f + x * (1.0f / 6 + x * (1.0f / 24 + x * (1.0f / 120)))));
        float e = disti_exp(x), below = x <= -0.1f ? e - 1.0f : near_zero;
        v = x > 0.0f ? x : below;
        d = x > 0.0f ? 1.0f : e;
        break;
    }
    case DIST_ACTIVATION_SOFTPLUS: {
        float a = scale * x;
        v = (x < 0.0f ? 0.0f : x) + disti_log1p_exp(a) * (1.0f / scale);
        d = disti_sigmoid(a);
        break;
    }
    case DIST_ACTIVATION_SINE: {
        float most = 1e9f / scale, within = x < most ? x : 0.0f; /* also for NaN */
        v = disti_sine((double)scale * (double)(within > -most ? within : 0.0f), &d) + (x - x);
        d *= scale;
        break;
    }
    case DIST_ACTIVATION_TANH:
        v = disti_tanh(x);
        d = disti_tanh_slope(x);
        break;
    case DIST_ACTIVATION_NONE: break;
    }
    *slope = d;
    return v;
}

DISTI_INLINE void disti_activate_loop(int activation, float scale, size_t n, float *DISTI_RESTRICT y,
                                      float *DISTI_RESTRICT slope)
{
    float d;
    if (slope)
        for (size_t i = 0; i < n; i++) y[i] = disti_activate_one(activation, scale, y[i], slope + i);
    else
        for (size_t i = 0; i < n; i++) y[i] = disti_activate_one(activation, scale, y[i], &d);
}

/* y <- activation(y), n values; slope (n) gets its derivative unless NULL. */
DISTI_INLINE void disti_activate(int activation, float scale, size_t n, float *y, float *slope)
{
    switch (activation) { /* by a constant each, so that the loops have no choice in them */
    case DIST_ACTIVATION_RELU: disti_activate_loop(DIST_ACTIVATION_RELU, scale, n, y, slope); break;
    case DIST_ACTIVATION_ELU: disti_activate_loop(DIST_ACTIVATION_ELU, scale, n, y, slope); break;
    case DIST_ACTIVATION_SOFTPLUS: disti_activate_loop(DIST_ACTIVATION_SOFTPLUS, scale, n, y, slope); break;
    case DIST_ACTIVATION_SINE: disti_activate_loop(DIST_ACTIVATION_SINE, scale, n, y, slope); break;
    case DIST_ACTIVATION_TANH: disti_activate_loop(DIST_ACTIVATION_TANH, scale, n, y, slope); break;
    case DIST_ACTIVATION_NONE: disti_activate_loop(DIST_ACTIVATION_NONE, scale, n, y, slope); break;
    }
}

/* backward  d_x = phi'(x) d_y
   tangents  of y' = phi'(x) x' in the lanes from `half` on, where that is not 0:  d_x = phi' d_y + phi''(x) x' d_y',
             d_x' = phi' d_y', and their slopes are phi'' x' (disti_hidden)
   n rows, in place: d is d_y, then d_x */
DISTI_INLINE void disti_activate_backward(size_t n, size_t half, const float *DISTI_RESTRICT slope,
                                          float *DISTI_RESTRICT d)
{
    if (!half) {
        for (size_t i = 0; i < n * DISTI_BLOCK; i++) d[i] *= slope[i];
        return;
    }
    for (size_t u = 0; u < n; u++, slope += DISTI_BLOCK, d += DISTI_BLOCK) {
        for (size_t c = 0; c < half; c++) d[c] = slope[c] * d[c] + slope[c + half] * d[c + half];
        for (size_t c = 0; c < half; c++) d[c + half] *= slope[c];
    }
}

/* phi'' of a value v = phi(x) whose slope phi'(x) is d. */
DISTI_INLINE float disti_curvature(int activation, float scale, float v, float d)
{
    switch (activation) {
    case DIST_ACTIVATION_ELU: return v > 0.0f ? 0.0f : d;
    case DIST_ACTIVATION_SOFTPLUS: return scale * d * disti_exp_falling(scale * v); /* 1 - d without cancellation */
    case DIST_ACTIVATION_SINE: return -scale * scale * v;
    case DIST_ACTIVATION_TANH: return -2.0f * v * d;
    }
    return 0.0f;
}

DISTI_INLINE void disti_tangents_loop(int activation, float scale, size_t n, float *DISTI_RESTRICT y,
                                      float *DISTI_RESTRICT slope, uint64_t *mask)
{
    enum { HALF = DISTI_BLOCK / 2 };
    float own[DISTI_BLOCK];
    for (size_t u = 0; u < n; u++) {
        float *DISTI_RESTRICT v = y + u * DISTI_BLOCK, *DISTI_RESTRICT d = slope ? slope + u * DISTI_BLOCK : own;
        uint32_t alive = 0;
        for (size_t c = 0; c < HALF; c++) v[c] = disti_activate_one(activation, scale, v[c], d + c);
        for (size_t c = 0; c < HALF; c++) {
            d[HALF + c] = disti_curvature(activation, scale, v[c], d[c]) * v[HALF + c];
            v[HALF + c] *= d[c];
        }
        if (activation != DIST_ACTIVATION_RELU) continue;
        for (size_t c = 0; c < HALF; c++) alive |= (uint32_t)(d[c] > 0.0f) << c;
        mask[u] = (uint64_t)alive << HALF | alive; /* a value and its tangent are alive together */
    }
}

/* n rows of values x and tangents x': y = phi(x), y' = phi'(x) x'; slope, unless NULL, gets phi' and phi'' x', and
   ReLU's mask which lanes are alive. */
DISTI_INLINE void disti_activate_tangents(int activation, float scale, size_t n, float *y, float *slope, uint64_t *mask)
{
    switch (activation) {
    case DIST_ACTIVATION_RELU: disti_tangents_loop(DIST_ACTIVATION_RELU, scale, n, y, slope, mask); break;
    case DIST_ACTIVATION_ELU: disti_tangents_loop(DIST_ACTIVATION_ELU, scale, n, y, slope, mask); break;
    case DIST_ACTIVATION_SOFTPLUS: disti_tangents_loop(DIST_ACTIVATION_SOFTPLUS, scale, n, y, slope, mask); break;
    case DIST_ACTIVATION_SINE: disti_tangents_loop(DIST_ACTIVATION_SINE, scale, n, y, slope, mask); break;
    case DIST_ACTIVATION_TANH: disti_tangents_loop(DIST_ACTIVATION_TANH, scale, n, y, slope, mask); break;
    case DIST_ACTIVATION_NONE: disti_tangents_loop(DIST_ACTIVATION_NONE, scale, n, y, slope, mask); break;
    }
}

/* LayerNorm's mu and 1 / sigma, and x - mu in hat, of `lanes` lanes in rows of `stride`. */
DISTI_INLINE void disti_norm_sums(int units, size_t lanes, size_t stride, float epsilon, const float *DISTI_RESTRICT x,
                                  float *DISTI_RESTRICT hat, float *DISTI_RESTRICT mean, float *DISTI_RESTRICT inverse)
{
    float variance[DISTI_BLOCK];
    size_t count = (size_t)units;
    for (size_t c = 0; c < lanes; c++) mean[c] = variance[c] = 0.0f;
    for (size_t u = 0; u < count; u++)
        for (size_t c = 0; c < lanes; c++) mean[c] += x[u * stride + c];
    for (size_t c = 0; c < lanes; c++) mean[c] /= (float)units;
    for (size_t u = 0; u < count; u++) {
        for (size_t c = 0; c < lanes; c++) {
            float d = x[u * stride + c] - mean[c];
            hat[u * stride + c] = d;
            variance[c] += d * d;
        }
    }
    int large = 0;
    for (size_t c = 0; c < lanes; c++) large |= !(variance[c] < 3e38f);
    for (size_t c = 0; c < lanes; c++) inverse[c] = 1.0f / sqrtf(variance[c] / (float)units + epsilon);
    for (size_t c = 0; large && c < lanes; c++) { /* squares that do not fit a float */
        double sum = 0.0;
        if (variance[c] < 3e38f) continue;
        for (size_t u = 0; u < count; u++) sum += (double)hat[u * stride + c] * (double)hat[u * stride + c];
        inverse[c] = (float)(1.0 / sqrt(sum / (double)units + (double)epsilon));
    }
}

/* forward   mu = mean_u x, v = mean_u (x - mu)^2, hat = (x - mu) / sqrt(v + eps), y = gamma hat + beta, for each of the
   first `lanes` lanes */
DISTI_INLINE void disti_norm_lanes(int units, size_t lanes, float epsilon, const float *gamma, const float *beta,
                                   float *DISTI_RESTRICT x, float *DISTI_RESTRICT hat, float *DISTI_RESTRICT inverse)
{
    float mean[DISTI_BLOCK];
    disti_norm_sums(units, lanes, DISTI_BLOCK, epsilon, x, hat, mean, inverse);
    for (size_t u = 0; u < (size_t)units; u++) {
        for (size_t c = 0; c < lanes; c++) {
            float h = hat[u * DISTI_BLOCK + c] * inverse[c];
            hat[u * DISTI_BLOCK + c] = h;
            x[u * DISTI_BLOCK + c] = gamma[u] * h + beta[u];
        }
    }
}

/* Its bits, with -ffast-math or x87 to rounding, for points y (points, stride), which x has as (units, FEW_LANES): that
   is what the sums go over, in the same order. */
DISTI_INLINE void disti_norm_points(int units, int points, size_t stride, float epsilon, const float *gamma,
                                    const float *beta, const float *DISTI_RESTRICT x, float *DISTI_RESTRICT hat,
                                    float *DISTI_RESTRICT y)
{
    float mean[DISTI_FEW_LANES], inverse[DISTI_FEW_LANES];
    disti_norm_sums(units, DISTI_FEW_LANES, DISTI_FEW_LANES, epsilon, x, hat, mean, inverse);
    for (int c = 0; c < points; c++, y += stride) {
        const float middle = mean[c], factor = inverse[c];
        for (size_t u = 0; u < (size_t)units; u++) {
            float h = (y[u] - middle) * factor;
            y[u] = gamma[u] * h + beta[u];
        }
    }
}

/* d <- P d / sigma,  P d = d - mean_u d - hat mean_u (d hat), for `lanes` lanes; along gets mean_u (d hat). P is
   symmetric: a tangent goes forward through it as a gradient goes back. */
DISTI_INLINE void disti_norm_project(int units, size_t lanes, const float *DISTI_RESTRICT hat,
                                     const float *DISTI_RESTRICT inverse, float *DISTI_RESTRICT d,
                                     float *DISTI_RESTRICT along)
{
    float mean[DISTI_BLOCK], share = 1.0f / (float)units;
    size_t count = (size_t)units * DISTI_BLOCK;
    for (size_t c = 0; c < lanes; c++) mean[c] = along[c] = 0.0f;
    for (size_t u = 0; u < count; u += DISTI_BLOCK) {
        for (size_t c = 0; c < lanes; c++) {
            mean[c] += share * d[u + c];
            along[c] += share * d[u + c] * hat[u + c];
        }
    }
    for (size_t u = 0; u < count; u += DISTI_BLOCK)
        for (size_t c = 0; c < lanes; c++) d[u + c] = (d[u + c] - mean[c] - hat[u + c] * along[c]) * inverse[c];
}

/* disti_norm_lanes of the values in the first half of the lanes, then their tangents in the others:
   hat' = P x' / sqrt(v + eps),  y' = gamma hat'; the inverse's place gets mean_u (hat x') */
DISTI_INLINE void disti_norm_tangent_lanes(int units, float epsilon, const float *gamma, const float *beta,
                                           float *DISTI_RESTRICT x, float *DISTI_RESTRICT hat,
                                           float *DISTI_RESTRICT inverse)
{
    enum { HALF = DISTI_BLOCK / 2 };
    disti_norm_lanes(units, HALF, epsilon, gamma, beta, x, hat, inverse);
    disti_norm_project(units, HALF, hat, inverse, x + HALF, inverse + HALF);
    x += HALF;
    hat += HALF;
    for (int u = 0; u < units; u++, x += DISTI_BLOCK, hat += DISTI_BLOCK, gamma++) {
        for (size_t c = 0; c < HALF; c++) hat[c] = x[c];
        for (size_t c = 0; c < HALF; c++) x[c] *= *gamma;
    }
}

/* backward  d_x = P gamma d_y / sigma     in place: d is d_y, then d_x
   tangents  d_x' = P gamma d_y' / sigma, and from hat' to x, with g' = gamma d_y':
             d_x -= (hat mean_u (g' hat') + hat' mean_u (g' hat) + d_x' mean_u (hat x')) / sigma */
DISTI_INLINE void disti_norm_backward(int units, const float *gamma, size_t half, const float *DISTI_RESTRICT hat,
                                      const float *DISTI_RESTRICT inverse, float *DISTI_RESTRICT d)
{
    float along[DISTI_BLOCK], cross[DISTI_BLOCK];
    size_t count = (size_t)units * DISTI_BLOCK;
    for (size_t u = 0; u < count; u += DISTI_BLOCK, gamma++)
        for (size_t c = 0; c < DISTI_BLOCK; c++) d[u + c] *= *gamma;
    if (!half) { /* by a constant, for the loops' sake */
        disti_norm_project(units, DISTI_BLOCK, hat, inverse, d, along);
        return;
    }
    half = DISTI_BLOCK / 2; /* which it is */
    disti_norm_project(units, half, hat, inverse, d, along);
    memset(cross, 0, sizeof cross);
    for (size_t u = half; u < count; u += DISTI_BLOCK)
        for (size_t c = 0; c < half; c++) cross[c] += d[u + c] * hat[u + c] / (float)units;
    disti_norm_project(units, half, hat, inverse, d + half, along);
    for (size_t u = 0; u < count; u += DISTI_BLOCK)
        for (size_t c = 0; c < half; c++)
            d[u + c] -= inverse[c] * (hat[u + c] * cross[c] + hat[u + half + c] * along[c] +
                                            d[u + half + c] * inverse[half + c]);
}

/* y <- max(0, y) and the bits of the lanes of each row that are positive, or NaN */
static void disti_relu_scalar(size_t rows, float *y, uint64_t *mask)
{
    for (size_t u = 0; u < rows; u++) {
        mask[u] = 0;
        for (size_t c = 0; c < DISTI_BLOCK; c++) {
            if (y[u * DISTI_BLOCK + c] <= 0.0f) y[u * DISTI_BLOCK + c] = 0.0f;
            else mask[u] |= (uint64_t)1 << c;
        }
    }
}

static void disti_few_scalar(const disti_few *g)
{
    const int relu = g->relu;
    const float none[8] = {0.0f};
    for (int o = 0; o < (g->out + 7) / 8 * 8; o += 8) {
        const float *weights = g->weights + (size_t)o * (size_t)g->rows;
        for (int i = 0; i < 8; i++) g->sum[o + i] = 0.0f;
        for (size_t c = 0; c < (size_t)g->points; c++) {
            const float *x = g->x + c * g->stride, *bias = c < (size_t)g->biased ? g->bias + o : none;
            float *y = g->y + c * g->stride + o;
#define DISTI_BEGIN(j) float a##j = bias[j], b##j = bias[4 + j];
#define DISTI_TERM(j) a##j += w[j] * x[k]; b##j += w[4 + j] * x[k];
#define DISTI_END(j) y[j] = relu && a##j <= 0.0f ? 0.0f : a##j; y[4 + j] = relu && b##j <= 0.0f ? 0.0f : b##j;
            DISTI_FOUR(DISTI_BEGIN)
            for (int i = 0; i < g->count; i++) {
                const size_t k = (size_t)g->list[i];
                const float *w = weights + k * 8;
                DISTI_FOUR(DISTI_TERM)
            }
            DISTI_FOUR(DISTI_END)
#undef DISTI_BEGIN
#undef DISTI_TERM
#undef DISTI_END
            for (int i = 0; i < 8 && relu; i++) g->sum[o + i] += y[i];
        }
    }
}
#undef DISTI_FOUR

static void disti_transpose_scalar(const float *const *rows, float scale, float *to, size_t stride)
{
    for (size_t c = 0; c < DISTI_BLOCK; c++, to += stride)
        for (size_t k = 0; k < 16; k++) to[k] = scale * rows[k][c];
}

static void disti_bound_scalar(const disti_bound *g)
{
    for (int b = 0; b < g->blocks; b++) {
        const int *list = g->list + (size_t)b * g->list_stride;
        float *sum = g->sum + (size_t)b * 5 * g->stride;
        for (int o = 0; o < (g->out + 7) / 8 * 8; o++) {
            const float *w = g->weights + (size_t)(o / 8) * (size_t)g->rows * 8 + o % 8;
            const float *m = g->model + (size_t)b * g->stride * 8;
            float s[5] = {0, 0, 0, 0, 0};
            for (int i = 0; i < g->count[b]; i++, m += 8) {
                const float v = w[(size_t)list[i] * 8];
                for (int j = 0; j < 4; j++) s[j] += v * m[j];
                s[4] += (v < 0.0f ? -v : v) * m[4];
            }
            for (size_t j = 0; j < 5; j++) sum[j * g->stride + (size_t)o] = s[j];
        }
    }
}

DISTI_INLINE void disti_live(size_t out, const float *DISTI_RESTRICT sum, size_t stride,
                             const float *DISTI_RESTRICT bias, float slack, const float *DISTI_RESTRICT cell,
                             int *DISTI_RESTRICT live)
{
    const float *DISTI_RESTRICT x = sum + stride, *DISTI_RESTRICT y = x + stride, *DISTI_RESTRICT z = y + stride;
    const float *DISTI_RESTRICT e = z + stride;
    for (size_t o = 0; o < out; o++) {
        const float u = fabsf(x[o]), v = fabsf(y[o]), w = fabsf(z[o]);
        float most = -3e38f;
        for (size_t i = 0; i < 6 * DISTI_CELLS; i += 6) {
            float t = x[o] * cell[i] + y[o] * cell[i + 1] + z[o] * cell[i + 2] + u * cell[i + 3] + v * cell[i + 4] +
                      w * cell[i + 5];
            most = t > most ? t : most;
        }
        most = most + sum[o] + bias[o] + e[o] + slack * fabsf(bias[o]);
        live[o] = (int)!(most < 0.0f) | (int)!(most > -3e38f);
    }
}

DISTI_INLINE void disti_fit_slope(const disti_fit *g, size_t row, float *m)
{
    const int full = g->mask[row] == ((uint64_t)1 << g->columns) - 1;
    const float factor = 0.5f + 0.5f * (float)full, *s = g->sum + g->stride + row;
    m[1] = factor * s[0];
    m[2] = factor * s[g->stride];
    m[3] = factor * s[2 * g->stride];
}

DISTI_INLINE void disti_fit_range(const disti_fit *g, float least, float most, float *m)
{
    const float middle = 0.5f * (least + most), range = DISTI_MAX(most - middle, middle - least);
    const float reach = fabsf(m[1]) * g->half[0] + fabsf(m[2]) * g->half[1] + fabsf(m[3]) * g->half[2];
    m[0] = middle;
    m[4] = range + g->slack * (range + reach + fabsf(middle));
}

static void disti_fit_scalar(const disti_fit *g)
{
    for (int i = 0; i < g->count; i++) {
        const size_t row = (size_t)g->list[i];
        const float *x = g->x + row * DISTI_BLOCK, *p = g->d;
        float *m = g->model + (size_t)i * 8, least = 3e38f, most = -3e38f;
        disti_fit_slope(g, row, m);
        for (int c = 0; c < g->columns; c++, p++) {
            float r = x[c] - (m[1] * p[0] + m[2] * p[DISTI_BLOCK] + m[3] * p[2 * DISTI_BLOCK]);
            least = r < least ? r : least;
            most = r > most ? r : most;
        }
        disti_fit_range(g, least, most, m);
    }
}

DISTI_INLINE int disti_huge_any(size_t n, const float *x)
{
    int32_t most = 0;
    for (size_t i = 0; i < n; i++) {
        int32_t bits;
        memcpy(&bits, x + i, sizeof bits);
        bits &= 0x7fffffff;
        most = bits > most ? bits : most;
    }
    return most >= 0x5b800000;
}

DISTI_INLINE void disti_axpy(size_t n, double s, const float *DISTI_RESTRICT x, double *DISTI_RESTRICT y)
{
    for (size_t i = 0; i < n; i++) y[i] += s * (double)x[i];
}

DISTI_INLINE void disti_rows(const float *DISTI_RESTRICT points, float *DISTI_RESTRICT rows)
{
    for (size_t c = 0; c < DISTI_BLOCK; c++) {
        rows[c] = points[3 * c];
        rows[DISTI_BLOCK + c] = points[3 * c + 1];
        rows[2 * DISTI_BLOCK + c] = points[3 * c + 2];
    }
}

DISTI_INLINE void disti_points(const float *DISTI_RESTRICT rows, float *DISTI_RESTRICT points)
{
    for (size_t c = 0; c < DISTI_BLOCK; c++) {
        points[3 * c] = rows[c];
        points[3 * c + 1] = rows[DISTI_BLOCK + c];
        points[3 * c + 2] = rows[2 * DISTI_BLOCK + c];
    }
}

/* Rows sin(base 2^k x) and cos(base 2^k x), k < levels, `stride` floats apart, by doubling the angle in double. */
DISTI_INLINE void disti_angles(double base, int levels, const float *DISTI_RESTRICT x, size_t stride,
                               float *DISTI_RESTRICT sines, float *DISTI_RESTRICT cosines)
{
    double s[DISTI_BLOCK], co[DISTI_BLOCK];
    for (size_t c = 0; c < DISTI_BLOCK; c++) disti_sincos(base * (double)x[c], &s[c], &co[c]);
    for (int k = 0; k < levels; k++, sines += stride, cosines += stride) {
        for (size_t c = 0; c < DISTI_BLOCK; c++) {
            sines[c] = (float)s[c];
            cosines[c] = (float)co[c];
            double twice = 2.0 * s[c] * co[c];
            co[c] = 1.0 - 2.0 * s[c] * s[c];
            s[c] = twice;
        }
    }
}

/* These of a block from the same text for every instruction set; scalar is the definition, as above. */
#define DISTI_PLAIN(isa, function)                                                                                     \
    function void disti_activate_##isa(int activation, float scale, size_t n, float *y, float *slope)                  \
    { disti_activate(activation, scale, n, y, slope); }                                                                \
    function void disti_norm_##isa(int units, float epsilon, const float *gamma, const float *beta, float *x,          \
                                    float *hat, float *inverse)                                                        \
    { disti_norm_lanes(units, DISTI_BLOCK, epsilon, gamma, beta, x, hat, inverse); }                                   \
    function void disti_norm_few_##isa(int units, int points, size_t stride, float epsilon, const float *gamma,        \
                                        const float *beta, const float *x, float *hat, float *y)                       \
    { disti_norm_points(units, points, stride, epsilon, gamma, beta, x, hat, y); }                                     \
    function void disti_activate_back_##isa(size_t n, size_t half, const float *slope, float *d)                       \
    { disti_activate_backward(n, half, slope, d); }                                                                    \
    function void disti_norm_tangents_##isa(int units, float epsilon, const float *gamma, const float *beta, float *x, \
                                             float *hat, float *inverse)                                               \
    { disti_norm_tangent_lanes(units, epsilon, gamma, beta, x, hat, inverse); }                                        \
    function void disti_activate_tangents_##isa(int activation, float scale, size_t n, float *y, float *slope,         \
                                                 uint64_t *mask)                                                       \
    { disti_activate_tangents(activation, scale, n, y, slope, mask); }                                                 \
    function int disti_huge_##isa(size_t n, const float *x) { return disti_huge_any(n, x); }                           \
    function void disti_norm_back_##isa(int units, const float *gamma, size_t half, const float *hat,                  \
                                         const float *inverse, float *d)                                               \
    { disti_norm_backward(units, gamma, half, hat, inverse, d); }                                                      \
    function void disti_rows_##isa(const float *points, float *rows) { disti_rows(points, rows); }                     \
    function void disti_points_##isa(const float *rows, float *points) { disti_points(rows, points); }                 \
    function void disti_angles_##isa(double base, int levels, const float *x, size_t stride, float *sines,             \
                                      float *cosines)                                                                  \
    { disti_angles(base, levels, x, stride, sines, cosines); }                                                         \
    function void disti_axpy_##isa(size_t n, double s, const float *x, double *y)                                      \
    { disti_axpy(n, s, x, y); }                                                                                        \
    function void disti_live_##isa(size_t out, const float *sum, size_t stride, const float *bias, float slack,        \
                                    const float *cell, int *live)                                                      \
    { disti_live(out, sum, stride, bias, slack, cell, live); }
DISTI_PLAIN(scalar, static)

#if defined(DISTI_X86) || defined(DISTI_NEON)

/* One text serves every instruction set. It is written in these words, which each set defines for itself:
     DISTI_FUNCTION                     what stands before each of its functions
     DISTI_VEC, DISTI_LANES             a vector, and how many floats it holds
     DISTI_SET1(s) DISTI_LOAD(p) DISTI_STORE(p, v) DISTI_ADD(a, b)
     DISTI_FMA(c, a, b)                 c += a b, in place: from intrinsics gcc makes copies and runs out of registers
     DISTI_RELU(v) DISTI_POSITIVE(v)    max(v, 0), and the bits of the lanes that are greater than 0: NaN stays and is
                                        greater (of two numbers of which one is NaN, x86's max is the second)
     DISTI_KEEP(v, bits)                v with 0 where the lane's bit is 0
     DISTI_TALL(isa)                    tiles of one vector's columns, where there are registers for sixteen rows
     DISTI_FEW(isa)                     the reverse pass of up to four rows, where other tiles are higher
     DISTI_DEPTH                        rows that one pass takes: the columns of a tile in them, 128 bytes of a row
                                        for AVX2, fill half a first cache of 32 KiB, the weights' stream the rest;
                                        wider vectors ask for less and can use the second cache
   A tile of R rows and V vectors keeps its sums in variables a<row><vector>: gcc holds those in registers where it
   would spill an array. A row's factor is broadcast and serves its V vectors; in the forward pass the factors of a
   tile stand side by side, elsewhere at R offsets k<row>. */
#define DISTI_X1(M, i) M(i, 0)
#define DISTI_X2(M, i) M(i, 0) M(i, 1)
#define DISTI_X3(M, i) M(i, 0) M(i, 1) M(i, 2)
#define DISTI_X4(M, i) M(i, 0) M(i, 1) M(i, 2) M(i, 3)
#define DISTI_Y1(M, V) M(0, V)
#define DISTI_Y2(M, V) M(0, V) M(1, V)
#define DISTI_Y4(M, V) DISTI_Y2(M, V) M(2, V) M(3, V)
#define DISTI_Y6(M, V) DISTI_Y4(M, V) M(4, V) M(5, V)
#define DISTI_Y8(M, V) DISTI_Y6(M, V) M(6, V) M(7, V)
#define DISTI_Y10(M, V) DISTI_Y8(M, V) M(8, V) M(9, V)
#define DISTI_Y12(M, V) DISTI_Y10(M, V) M(10, V) M(11, V)
#define DISTI_Y16(M, V) DISTI_Y12(M, V) M(12, V) M(13, V) M(14, V) M(15, V)

#define DISTI_ZERO1(i, j) DISTI_VEC a##i##j = DISTI_SET1(0.0f);
#define DISTI_AGAIN1(i, j) a##i##j = DISTI_LOAD(y + i * DISTI_BLOCK + j * DISTI_LANES);
#define DISTI_ZERO(i, V) DISTI_X##V(DISTI_ZERO1, i)
#define DISTI_AGAIN(i, V) DISTI_X##V(DISTI_AGAIN1, i)

#define DISTI_INPUT(i, j) const DISTI_VEC x##j = DISTI_LOAD(xs + j * DISTI_LANES);
#define DISTI_MAC(i, j) DISTI_FMA(a##i##j, b, x##j);
#define DISTI_SIDE(i, V) { const DISTI_VEC b = DISTI_SET1(ws[i]); DISTI_X##V(DISTI_MAC, i) }
#define DISTI_ABOVE(i, V) { const DISTI_VEC b = DISTI_SET1(ws[(i) / 8 * panel + (i) % 8]); DISTI_X##V(DISTI_MAC, i) }
#define DISTI_APART(i, V) { const DISTI_VEC b = DISTI_SET1(ws[k##i]); DISTI_X##V(DISTI_MAC, i) }
#define DISTI_STEP(R, V, FACTORS, w, x) \
    { const float *const ws = w, *const xs = x; DISTI_X##V(DISTI_INPUT, 0) DISTI_Y##R(FACTORS, V) DISTI_FENCE }

/* Not where a sum is two operations: -ffast-math would reorder the terms of several steps, and dead rows would show. */
#define DISTI_UNROLLED (DISTI_LANES > 4)
/* Keeps gcc from mixing the loads of unrolled steps until it runs out of registers. */
#if defined(__GNUC__) && !defined(__clang__)
#define DISTI_FENCE __asm__ volatile("" : : : "memory");
#else
#define DISTI_FENCE
#endif

/* Prefetches reach beyond the end of an array, where a pointer may not go. */
#define DISTI_AHEAD(p, floats) DISTI_PREFETCH((const char *)((uintptr_t)(p) + sizeof(float) * (size_t)(floats)))
#define DISTI_VECTORS(floats) (((floats) + DISTI_LANES - 1) / DISTI_LANES)

#define DISTI_STORE_RELU1(i, j)                                                                                        \
    a##i##j = DISTI_ADD(a##i##j, b);                                                                                   \
    bits |= (uint64_t)DISTI_POSITIVE(a##i##j) << (j * DISTI_LANES);                                                    \
    DISTI_STORE(line + j * DISTI_LANES, DISTI_RELU(a##i##j));
#define DISTI_STORE_POSITIVE1(i, j) \
    DISTI_STORE(y + i * DISTI_BLOCK + j * DISTI_LANES, DISTI_RELU(DISTI_ADD(a##i##j, b)));
/* Minus zero becomes zero, so that a zero row left out cannot show in its sign. */
#define DISTI_STORE_SUM1(i, j) \
    DISTI_STORE(y + i * DISTI_BLOCK + j * DISTI_LANES, DISTI_ADD(DISTI_ADD(a##i##j, b), DISTI_SET1(0.0f)));
#define DISTI_STORE_PART1(i, j) DISTI_STORE(y + i * DISTI_BLOCK + j * DISTI_LANES, a##i##j);
#define DISTI_STORE_PART(i, V) DISTI_X##V(DISTI_STORE_PART1, i)
#define DISTI_STORE_SUM(i, V) { const DISTI_VEC b = DISTI_SET1(bias[i]); DISTI_X##V(DISTI_STORE_SUM1, i) }
#define DISTI_STORE_RELU(i, V)                                                                                         \
    {                                                                                                                  \
        const DISTI_VEC b = DISTI_SET1(bias[i]);                                                                       \
        float *const line = y + i * DISTI_BLOCK;                                                                       \
        uint64_t bits = 0;                                                                                             \
        DISTI_X##V(DISTI_STORE_RELU1, i)                                                                               \
        mask[i] |= bits << c;                                                                                          \
    }
#define DISTI_STORE_POSITIVE(i, V) { const DISTI_VEC b = DISTI_SET1(bias[i]); DISTI_X##V(DISTI_STORE_POSITIVE1, i) }

/* Takes inputs from..to-1 of the list or of all; between two passes over DISTI_DEPTH rows the sums wait in y.
   Weights are fetched `ahead` floats early: a little, or a whole panel where passes cut the panels. A tall tile, which
   waits for memory most, fetches sixteen entries of its list early, at the end those of the tile that follows. */
#define DISTI_GEMM_TILE(name, R, V, FACTORS)                                                                           \
    DISTI_NOINLINE DISTI_FUNCTION void disti_gemm_##name(const disti_gemm *g, int o, int c, int from, int to,          \
                                                          size_t ahead)                                                \
    {                                                                                                                  \
        const size_t panel = (size_t)g->rows * 8, at = (size_t)(unsigned)o;                                            \
        const float *w = g->weights + at / 8 * panel + at % 8;                                                         \
        const float *x = g->x + c;                                                                                     \
        const float *bias = g->bias + o;                                                                               \
        float *y = g->y + at * DISTI_BLOCK + c;                                                                        \
        DISTI_Y##R(DISTI_ZERO, V)                                                                                      \
        if (from > 0) {                                                                                                \
            DISTI_Y##R(DISTI_AGAIN, V)                                                                                 \
        }                                                                                                              \
        if (g->alive) {                                                                                                \
            const int *alive = g->alive + from, *const end = g->alive + to, *next = alive + DISTI_MIN(16, to - from);  \
            size_t later = 0;                                                                                          \
            for (; alive < end; alive++) {                                                                             \
                const size_t k = (size_t)(unsigned)*alive;                                                             \
                if (R > 8) {                                                                                           \
                    if (next == end) next = g->alive + from, later += 2 * panel;                                       \
                    DISTI_AHEAD(w, later + (size_t)(unsigned)*next * 8);                                               \
                    DISTI_AHEAD(w, later + panel + (size_t)(unsigned)*next++ * 8);                                     \
                } else {                                                                                               \
                    DISTI_AHEAD(w + k * 8, ahead);                                                                     \
                }                                                                                                      \
                DISTI_STEP(R, V, FACTORS, w + k * 8, x + k * DISTI_BLOCK)                                              \
            }                                                                                                          \
        } else {                                                                                                       \
            const float *end = w + (size_t)(unsigned)to * 8;                                                           \
            w += (size_t)(unsigned)from * 8;                                                                           \
            x += (size_t)(unsigned)from * DISTI_BLOCK;                                                                 \
            for (; DISTI_UNROLLED && end - w >= 2 * 8; w += 2 * 8, x += 2 * DISTI_BLOCK) {                             \
                DISTI_AHEAD(w, ahead);                                                                                 \
                if (R > 8) DISTI_AHEAD(w + panel, ahead);                                                              \
                DISTI_STEP(R, V, FACTORS, w, x)                                                                        \
                DISTI_STEP(R, V, FACTORS, w + 8, x + DISTI_BLOCK)                                                      \
            }                                                                                                          \
            for (; w < end; w += 8, x += DISTI_BLOCK) DISTI_STEP(R, V, FACTORS, w, x)                                  \
        }                                                                                                              \
        if (to < (g->alive ? g->alive_count : g->rows)) {                                                              \
            DISTI_Y##R(DISTI_STORE_PART, V)                                                                            \
        } else if (!g->mask && !g->relu) {                                                                             \
            DISTI_Y##R(DISTI_STORE_SUM, V)                                                                             \
        } else if (g->mask) {                                                                                          \
            uint64_t *mask = g->mask + o;                                                                              \
            DISTI_Y##R(DISTI_STORE_RELU, V)                                                                            \
        } else {                                                                                                       \
            DISTI_Y##R(DISTI_STORE_POSITIVE, V)                                                                        \
        }                                                                                                              \
    }

/* As above for outputs that stand in a list, with ReLU: o; from `count` on they repeat the last one. */
#define DISTI_PLACE(i, V) const size_t k##i = (size_t)(unsigned)(o[i] >> 3) * panel + (size_t)(unsigned)(o[i] & 7);
#define DISTI_SOME_STORE(i, V)                                                                                         \
    if (i < count) {                                                                                                   \
        const DISTI_VEC b = DISTI_SET1(g->bias[o[i]]);                                                                 \
        uint64_t bits = 0;                                                                                             \
        float *const line = g->y + (size_t)(unsigned)o[i] * DISTI_BLOCK + c;                                           \
        DISTI_X##V(DISTI_STORE_RELU1, i)                                                                               \
        g->mask[o[i]] |= bits << c;                                                                                    \
    }
#define DISTI_SOME_TILE(name, R, V)                                                                                    \
    DISTI_NOINLINE DISTI_FUNCTION void disti_some_##name(const disti_gemm *g, const int *o, int count, int c)          \
    {                                                                                                                  \
        const size_t panel = (size_t)(unsigned)g->rows * 8;                                                            \
        const float *w = g->weights, *x = g->x + c;                                                                    \
        const int *k = g->alive, *const end = k + g->alive_count;                                                      \
        DISTI_Y##R(DISTI_PLACE, V)                                                                                     \
        DISTI_Y##R(DISTI_ZERO, V)                                                                                      \
        for (; k < end; k++)                                                                                           \
            DISTI_STEP(R, V, DISTI_APART, w + (size_t)(unsigned)*k * 8, x + (size_t)(unsigned)*k * DISTI_BLOCK)        \
        DISTI_Y##R(DISTI_SOME_STORE, V)                                                                                \
    }

/* k: the rows of this tile; from `count` on they repeat the last one and are not stored. NULL: those from `first` on,
   whose places the compiler then knows. */
#define DISTI_LISTED(i, V) const size_t k##i = (size_t)(unsigned)k[i] * 8;
#define DISTI_NEXT(i, V) const size_t k##i = (i) * 8;
#define DISTI_RETURN1(i, j) a##i##j = DISTI_LOAD(d_x + k##i * (DISTI_BLOCK / 8) + j * DISTI_LANES);
#define DISTI_RETURN(i, V) DISTI_X##V(DISTI_RETURN1, i)
#define DISTI_STORE_KEEP1(i, j)                                                                                        \
    DISTI_STORE(d_x + k##i * (DISTI_BLOCK / 8) + j * DISTI_LANES, DISTI_KEEP(a##i##j, bits >> (j * DISTI_LANES)));
#define DISTI_STORE_KEEP(i, V)                                                                                         \
    if (i < count) {                                                                                                   \
        const uint64_t bits = mask ? mask[k##i / 8] >> c : ~(uint64_t)0;                                               \
        DISTI_X##V(DISTI_STORE_KEEP1, i)                                                                               \
    }
#define DISTI_STORE_SOON1(i, j) DISTI_STORE(d_x + k##i * (DISTI_BLOCK / 8) + j * DISTI_LANES, a##i##j);
#define DISTI_STORE_SOON(i, V) if (i < count) { DISTI_X##V(DISTI_STORE_SOON1, i) }

#define DISTI_BACK_TILE(name, R, V, PLACES)                                                                            \
    DISTI_NOINLINE DISTI_FUNCTION void disti_back_##name(const disti_gemm_back *g, const int *k, int first, int count, \
                                                          int c, int from, int to)                                     \
    {                                                                                                                  \
        const size_t panel = (size_t)g->rows * 8, at = (size_t)(unsigned)first;                                        \
        const float *weights = g->weights + at * 8, *d_y = g->d_y + c;                                                 \
        const float *next = k ? weights + (size_t)(unsigned)k[R - 1] * 8 + 8 : weights + R * 8;                        \
        const uint64_t *mask = g->mask ? g->mask + at : NULL;                                                          \
        float *d_x = g->d_x + at * DISTI_BLOCK + c;                                                                    \
        DISTI_Y##R(PLACES, V)                                                                                          \
        DISTI_Y##R(DISTI_ZERO, V)                                                                                      \
        if (from > 0) {                                                                                                \
            DISTI_Y##R(DISTI_RETURN, V)                                                                                \
        }                                                                                                              \
        if (g->alive_out) {                                                                                            \
            for (const int *alive = g->alive_out + from, *end = g->alive_out + to; alive < end; alive++) {             \
                const size_t o = (size_t)(unsigned)*alive;                                                             \
                DISTI_AHEAD(next, (o >> 3) * panel + (o & 7) * 8);                                                     \
                DISTI_STEP(R, V, DISTI_APART, weights + (o >> 3) * panel + (o & 7), d_y + o * DISTI_BLOCK)             \
            }                                                                                                          \
        } else {                                                                                                       \
            size_t o = (size_t)(unsigned)from;                                                                         \
            const size_t end = (size_t)(unsigned)to;                                                                   \
            const float *w = weights + (o >> 3) * panel, *x = d_y + o * DISTI_BLOCK;                                   \
            next += (o >> 3) * panel;                                                                                  \
            for (; DISTI_UNROLLED && o + 8 <= end; o += 8, w += panel - 8, next += panel) {                            \
                DISTI_AHEAD(next, 0);                                                                                  \
                DISTI_AHEAD(next, 16);                                                                                 \
                DISTI_AHEAD(next, 32);                                                                                 \
                DISTI_AHEAD(next, 48);                                                                                 \
                for (int half = 0; half < 2; half++, w += 4, x += 4 * DISTI_BLOCK) {                                   \
                    DISTI_STEP(R, V, DISTI_APART, w, x)                                                                \
                    DISTI_STEP(R, V, DISTI_APART, w + 1, x + DISTI_BLOCK)                                              \
                    DISTI_STEP(R, V, DISTI_APART, w + 2, x + 2 * DISTI_BLOCK)                                          \
                    DISTI_STEP(R, V, DISTI_APART, w + 3, x + 3 * DISTI_BLOCK)                                          \
                }                                                                                                      \
            }                                                                                                          \
            for (; o < end; o++)                                                                                       \
                DISTI_STEP(R, V, DISTI_APART, weights + (o >> 3) * panel + (o & 7), d_y + o * DISTI_BLOCK)             \
        }                                                                                                              \
        if (to < (g->alive_out ? g->alive_out_count : g->out)) { /* the last pass applies the mask */                  \
            DISTI_Y##R(DISTI_STORE_SOON, V)                                                                            \
        } else {                                                                                                       \
            DISTI_Y##R(DISTI_STORE_KEEP, V)                                                                            \
        }                                                                                                              \
    }

/* Only the last vector of a row can be a part of one. */
#define DISTI_OUTPUT(i, V) const size_t k##i = (size_t)(unsigned)DISTI_MIN(i, count - 1) * DISTI_BLOCK;
#define DISTI_ACCUMULATE1(i, j)                                                                                        \
    if ((j + 1) * DISTI_LANES <= floats) {                                                                             \
        DISTI_STORE(d_w + j * DISTI_LANES, DISTI_ADD(DISTI_LOAD(d_w + j * DISTI_LANES), a##i##j));                     \
    } else {                                                                                                           \
        DISTI_STORE(part, a##i##j);                                                                                    \
        for (int n = 0; n < floats - j * DISTI_LANES; n++) d_w[j * DISTI_LANES + n] += part[n];                        \
    }
#define DISTI_ACCUMULATE(i, V)                                                                                         \
    if (i < count) {                                                                                                   \
        float *d_w = d_weights + (size_t)i * g->stride;                                                                \
        DISTI_X##V(DISTI_ACCUMULATE1, i)                                                                               \
    }

#define DISTI_FETCH1(i, j) DISTI_AHEAD(d_weights, (size_t)i * g->stride + j * DISTI_LANES);
#define DISTI_FETCH(i, V) DISTI_X##V(DISTI_FETCH1, i) DISTI_FETCH1(i, V)
#define DISTI_WEIGHTS_TILE(name, R, V)                                                                                 \
    DISTI_NOINLINE DISTI_FUNCTION void disti_weights_##name(const disti_gemm_weights *g, int o, int k, const float *x, \
                                                             size_t x_stride)                                          \
    {                                                                                                                  \
        const int count = g->out - o, floats = g->rows - k;                                                            \
        const float *w = g->d_y + (size_t)o * DISTI_BLOCK, *end = w + g->columns;                                      \
        float *d_weights = g->d_weights + (size_t)o * g->stride + k;                                                   \
        float part[DISTI_LANES];                                                                                       \
        DISTI_Y##R(DISTI_FETCH, V)                                                                                     \
        DISTI_Y##R(DISTI_OUTPUT, V)                                                                                    \
        DISTI_Y##R(DISTI_ZERO, V)                                                                                      \
        for (; w < end; w++, x += x_stride) DISTI_STEP(R, V, DISTI_APART, w, x)                                        \
        DISTI_Y##R(DISTI_ACCUMULATE, V)                                                                                \
    }

#define DISTI_RELU_ROWS(isa)                                                                                           \
    DISTI_FUNCTION void disti_relu_##isa(size_t rows, float *y, uint64_t *mask)                                        \
    {                                                                                                                  \
        for (size_t u = 0; u < rows; u++, y += DISTI_BLOCK, mask++) {                                                  \
            uint64_t bits = 0;                                                                                         \
            for (int c = 0; c < DISTI_BLOCK; c += DISTI_LANES) {                                                       \
                const DISTI_VEC v = DISTI_LOAD(y + c);                                                                 \
                bits |= (uint64_t)DISTI_POSITIVE(v) << c;                                                              \
                DISTI_STORE(y + c, DISTI_RELU(v));                                                                     \
            }                                                                                                          \
            *mask = bits;                                                                                              \
        }                                                                                                              \
    }
#define DISTI_OUTER1(i, j)                                                                                             \
    {                                                                                                                  \
        DISTI_VEC product = zero;                                                                                      \
        DISTI_FMA(product, b, x##j);                                                                                   \
        DISTI_STORE(to + j * DISTI_LANES, DISTI_KEEP(product, bits >> (j * DISTI_LANES)));                             \
    }
#define DISTI_LANES1(i, j) { const DISTI_VEC b = DISTI_LOAD(x + j * DISTI_LANES); DISTI_FMA(a, b, x##j); }
#define DISTI_LAST_LAYER(isa)                                                                                          \
    DISTI_FUNCTION void disti_dot_##isa(                                                                               \
        const float *w, float bias_value, const float *matrix, const int *alive, int alive_count, int rows,            \
        int columns, float *out)                                                                                       \
    {                                                                                                                  \
        const float *bias = &bias_value;                                                                               \
        const int count = alive ? alive_count : rows;                                                                  \
        for (int c = 0; c < columns; c += 3 * DISTI_LANES) {                                                           \
            float *y = out + c;                                                                                        \
            DISTI_ZERO(0, 3)                                                                                           \
            for (int n = 0; n < count; n++) {                                                                          \
                const size_t k0 = (size_t)(unsigned)(alive ? alive[n] : n);                                            \
                DISTI_STEP(1, 3, DISTI_APART, w, matrix + k0 * DISTI_BLOCK + c)                                        \
            }                                                                                                          \
            DISTI_STORE_SUM(0, 3)                                                                                      \
        }                                                                                                              \
    }                                                                                                                  \
    DISTI_FUNCTION void disti_outer_##isa(                                                                             \
        const float *w, const float *s, const int *alive, int alive_count, int rows, int columns,                      \
        const uint64_t *mask, float *y)                                                                                \
    {                                                                                                                  \
        const DISTI_VEC zero = DISTI_SET1(0.0f);                                                                       \
        const int count = alive ? alive_count : rows;                                                                  \
        for (int c = 0; c < columns; c += 3 * DISTI_LANES) {                                                           \
            const float *const xs = s + c;                                                                             \
            DISTI_X3(DISTI_INPUT, 0)                                                                                   \
            for (int n = 0; n < count; n++) {                                                                          \
                const size_t k = (size_t)(unsigned)(alive ? alive[n] : n);                                             \
                const uint64_t bits = mask ? mask[k] >> c : ~(uint64_t)0;                                              \
                const DISTI_VEC b = DISTI_SET1(w[k]);                                                                  \
                float *to = y + k * DISTI_BLOCK + c;                                                                   \
                DISTI_X3(DISTI_OUTER1, 0)                                                                              \
            }                                                                                                          \
        }                                                                                                              \
    }                                                                                                                  \
    DISTI_FUNCTION void disti_lanes_##isa(                                                                             \
        const float *s, const float *matrix, const int *alive, int alive_count, int rows, int columns, float *sum)     \
    {                                                                                                                  \
        const int count = alive ? alive_count : rows;                                                                  \
        int c = 0;                                                                                                     \
        for (; c + 3 * DISTI_LANES <= columns; c += 3 * DISTI_LANES) {                                                 \
            const float *const xs = s + c;                                                                             \
            DISTI_X3(DISTI_INPUT, 0)                                                                                   \
            for (int n = 0; n < count; n++) {                                                                          \
                const size_t k = (size_t)(unsigned)(alive ? alive[n] : n);                                             \
                const float *x = matrix + k * DISTI_BLOCK + c;                                                         \
                DISTI_VEC a = DISTI_LOAD(sum + k * 16);                                                                \
                DISTI_X3(DISTI_LANES1, 0)                                                                              \
                DISTI_STORE(sum + k * 16, a);                                                                          \
            }                                                                                                          \
        }                                                                                                              \
        for (int n = 0; n < count && c < columns; n++) {                                                               \
            const size_t k = (size_t)(unsigned)(alive ? alive[n] : n);                                                 \
            const float *x = matrix + k * DISTI_BLOCK;                                                                 \
            DISTI_VEC a = DISTI_LOAD(sum + k * 16);                                                                    \
            int i = c;                                                                                                 \
            for (; i + DISTI_LANES <= columns; i += DISTI_LANES) {                                                     \
                const DISTI_VEC b = DISTI_LOAD(s + i), x0 = DISTI_LOAD(x + i);                                         \
                DISTI_FMA(a, b, x0);                                                                                   \
            }                                                                                                          \
            DISTI_STORE(sum + k * 16, a);                                                                              \
            for (; i < columns; i++) sum[k * 16] += s[i] * x[i];                                                       \
        }                                                                                                              \
    }

/* Where a pass ends: no few rows are left to one of their own. */
#define DISTI_UNTIL(from, count) ((count) - (from) <= DISTI_DEPTH + 16 ? (count) : (from) + DISTI_DEPTH)
/* All tiles of `total` rows, eight at a time: their strips are R rows high, of one vector eight. */
#define DISTI_EACH(kernel, isa, first, total, columns, R, W, arguments)                                                \
    for (int c = 0; c < (columns); c += W * DISTI_LANES) {                                                             \
        const int vectors = DISTI_VECTORS((columns) - c);                                                              \
        for (int row = first; row < (total); row += 8) {                                                               \
            for (int n = row; n < row + 8 && n < (total); n += vectors >= 2 ? R : 8) {                                 \
                if (vectors >= W) disti_##kernel##_wide_##isa arguments;                                               \
                else if (vectors == 2) disti_##kernel##_middle_##isa arguments;                                        \
                else disti_##kernel##_narrow_##isa arguments;                                                          \
            }                                                                                                          \
        }                                                                                                              \
    }
#define DISTI_DRIVERS(isa, R, W)                                                                                       \
    DISTI_FUNCTION void disti_gemm_##isa(const disti_gemm *g)                                                          \
    {                                                                                                                  \
        const int count = g->alive ? g->alive_count : g->rows, out = (g->out + 7) / 8 * 8;                             \
        const size_t ahead = DISTI_UNTIL(0, count) < count ? (size_t)g->rows * 8 : 256;                                \
        if (g->mask) memset(g->mask, 0, (size_t)(unsigned)out * sizeof(uint64_t));                                     \
        int to = 0;                                                                                                    \
        do {                                                                                                           \
            const int from = to;                                                                                       \
            to = DISTI_UNTIL(from, count);                                                                             \
            int first = 0;                                                                                             \
            DISTI_TALL(isa)                                                                                            \
            DISTI_EACH(gemm, isa, first, out, g->columns, R, W, (g, n, c, from, to, ahead))                            \
        } while (to < count);                                                                                          \
        if (!g->mask || g->columns == DISTI_BLOCK) return;                                                             \
        for (int o = 0; o < out; o++) g->mask[o] &= ((uint64_t)1 << g->columns) - 1;                                   \
    }                                                                                                                  \
    DISTI_FUNCTION void disti_gemm_some_##isa(const disti_gemm *g, const int *list, int count)                         \
    {                                                                                                                  \
        int o[8];                                                                                                      \
        memset(g->mask, 0, (size_t)(unsigned)g->out * sizeof(uint64_t));                                               \
        DISTI_EACH(some, isa, 0, count, g->columns, R, W, (g, disti_listed(list, count, n, o), count - n, c))          \
        if (g->columns == DISTI_BLOCK) return;                                                                         \
        for (int i = 0; i < count; i++) g->mask[list[i]] &= ((uint64_t)1 << g->columns) - 1;                           \
    }                                                                                                                  \
    DISTI_FUNCTION void disti_gemm_back_##isa(const disti_gemm_back *g)                                                \
    {                                                                                                                  \
        const int rows = g->alive_rows ? g->alive_rows_count : g->rows;                                                \
        const int count = g->alive_out ? g->alive_out_count : g->out;                                                  \
        const int next = g->alive_rows || g->columns % (W * DISTI_LANES) != 0 ? 0 : rows / 8 * 8;                      \
        int to = 0, k[8];                                                                                              \
        do {                                                                                                           \
            const int from = to;                                                                                       \
            to = DISTI_UNTIL(from, count);                                                                             \
            DISTI_FEW(isa)                                                                                             \
            for (int c = 0; c < g->columns && next > 0; c += W * DISTI_LANES)                                          \
                for (int n = 0; n < next; n += R) disti_back_next_##isa(g, NULL, n, R, c, from, to);                   \
            DISTI_EACH(back, isa, next, rows, g->columns, R, W,                                                        \
                       (g, disti_back_rows(g, rows, n, k), 0, rows - n, c, from, to))                                  \
        } while (to < count);                                                                                          \
    }                                                                                                                  \
    DISTI_FUNCTION void disti_gemm_weights_##isa(const disti_gemm_weights *g)                                          \
    {                                                                                                                  \
        float packed[DISTI_BLOCK * W * DISTI_LANES];                                                                   \
        for (int k = 0; k < g->rows; k += W * DISTI_LANES) {                                                           \
            const int floats = DISTI_MIN(g->rows - k, W * DISTI_LANES);                                                \
            const float *x = g->xt + k;                                                                                \
            size_t x_stride = g->xt_stride;                                                                            \
            if (x_stride > 128) {                                                                                      \
                const size_t bytes = (size_t)(DISTI_VECTORS(floats) * DISTI_LANES) * sizeof(float);                    \
                x_stride = W * DISTI_LANES;                                                                            \
                for (size_t c = 0; c < (size_t)(unsigned)g->columns; c++)                                              \
                    memcpy(packed + c * x_stride, x + c * g->xt_stride, bytes);                                        \
                x = packed;                                                                                            \
            }                                                                                                          \
            DISTI_EACH(weights, isa, 0, g->out, floats, R, W, (g, n, k, x, x_stride))                                  \
        }                                                                                                              \
    }

/* P points, V vectors of outputs; a point from g->points on is the last one again. */
#define DISTI_FEW_X(i, V) const float *x##i = g->x + (size_t)(unsigned)DISTI_MIN(i, g->points - 1) * g->stride;
#define DISTI_FEW_AT(i, j)                                                                                             \
    const int p##j = p + j * DISTI_LANES / 8, q##j = p##j + 1;                                                         \
    const size_t at##j = (size_t)(unsigned)DISTI_MIN(p##j, last) * 8 + (DISTI_LANES == 4 ? j % 2 * 4 : 0);             \
    const size_t to##j = (size_t)(unsigned)DISTI_MIN(q##j, last) * 8;                                                  \
    const float *w##j = g->weights + (at##j & ~(size_t)7) * rows + (at##j & 7), *u##j = g->weights + to##j * rows;     \
    DISTI_VEC m##j = DISTI_SET1(0.0f);
#define DISTI_FEW_INPUT(i, j) const DISTI_VEC v##j = DISTI_TWO(w##j + row, u##j + row);
#define DISTI_FEW_MAC(i, j) DISTI_FMA(a##i##j, b, v##j);
#define DISTI_FEW_ROW(i, V) { const DISTI_VEC b = DISTI_SET1(x##i[k]); DISTI_X##V(DISTI_FEW_MAC, i) }
#define DISTI_FEW_STORE1(i, j)                                                                                         \
    a##i##j = DISTI_ADD(a##i##j, i < g->biased ? DISTI_TWO(g->bias + at##j, g->bias + to##j) : DISTI_SET1(0.0f));      \
    if (g->relu) {                                                                                                     \
        a##i##j = DISTI_RELU(a##i##j);                                                                                 \
        m##j = DISTI_ADD(m##j, a##i##j);                                                                               \
    }                                                                                                                  \
    DISTI_TWO_STORE(y + at##j, y + to##j, a##i##j)
#define DISTI_FEW_STORE(i, V)                                                                                          \
    {                                                                                                                  \
        float *y = g->y + (size_t)(unsigned)DISTI_MIN(i, g->points - 1) * g->stride;                                   \
        DISTI_X##V(DISTI_FEW_STORE1, i)                                                                                \
    }
#define DISTI_FEW_SUM(i, j) DISTI_TWO_STORE(g->sum + at##j, g->sum + to##j, m##j)
#define DISTI_FEW_TILE(name, P, V)                                                                                     \
    DISTI_NOINLINE DISTI_FUNCTION void disti_few_##name(const disti_few *g)                                            \
    {                                                                                                                  \
        const int last = (g->out + 7) / 8 - 1;                                                                         \
        const size_t rows = (size_t)(unsigned)g->rows;                                                                 \
        DISTI_Y##P(DISTI_FEW_X, V)                                                                                     \
        for (int p = 0; p <= last; p += V * DISTI_LANES / 8) {                                                         \
            DISTI_X##V(DISTI_FEW_AT, 0)                                                                                \
            DISTI_Y##P(DISTI_ZERO, V)                                                                                  \
            for (const int *list = g->list, *end = list + g->count; list < end; list++) {                              \
                const size_t k = (size_t)(unsigned)*list, row = k * 8;                                                 \
                DISTI_X##V(DISTI_FEW_INPUT, 0)                                                                         \
                DISTI_Y##P(DISTI_FEW_ROW, V)                                                                           \
                DISTI_FENCE                                                                                            \
            }                                                                                                          \
            DISTI_Y##P(DISTI_FEW_STORE, V)                                                                             \
            DISTI_X##V(DISTI_FEW_SUM, 0)                                                                               \
        }                                                                                                              \
    }

/* Two vectors of outputs at a time: of one panel, of two, of four. */
#define DISTI_BOUND1(j)                                                                                                \
    { const DISTI_VEC b = DISTI_SET1(m[j]); DISTI_FMA(a0##j, b, v); DISTI_FMA(a1##j, b, w); }
#define DISTI_BOUND_ZERO(j) DISTI_VEC a0##j = DISTI_SET1(0.0f), a1##j = DISTI_SET1(0.0f);
#define DISTI_BOUND_STORE(j)                                                                                           \
    DISTI_TWO_STORE(sum + j * g->stride + at0, sum + j * g->stride + at2, a0##j)                                       \
    DISTI_TWO_STORE(sum + j * g->stride + at1, sum + j * g->stride + at3, a1##j)
#define DISTI_BOUND(isa)                                                                                               \
    DISTI_NOINLINE DISTI_FUNCTION void disti_bound_##isa(const disti_bound *g)                                         \
    {                                                                                                                  \
        const int last = (g->out + 7) / 8 - 1;                                                                         \
        const size_t rows = (size_t)(unsigned)g->rows;                                                                 \
        for (int p = 0; p <= last; p += DISTI_LANES / 4) {                                                             \
            const size_t at0 = (size_t)(unsigned)p * 8, at2 = (size_t)(unsigned)DISTI_MIN(p + 1, last) * 8;            \
            const size_t at1 = DISTI_LANES == 4 ? at0 + 4                                                              \
                                                : (size_t)(unsigned)DISTI_MIN(p + DISTI_LANES / 8, last) * 8;          \
            const size_t at3 = (size_t)(unsigned)DISTI_MIN(p + 3, last) * 8;                                           \
            const float *w0 = g->weights + at0 * rows, *w1 = g->weights + (at1 & ~(size_t)7) * rows + (at1 & 7);       \
            const float *w2 = g->weights + at2 * rows, *w3 = g->weights + at3 * rows;                                  \
            for (size_t block = 0; block < (size_t)(unsigned)g->blocks; block++) {                                     \
                const float *m = g->model + block * g->stride * 8;                                                     \
                const int *k = g->list + block * g->list_stride, *end = k + g->count[block];                           \
                float *sum = g->sum + block * 5 * g->stride;                                                           \
                DISTI_BOUND_ZERO(0) DISTI_BOUND_ZERO(1) DISTI_BOUND_ZERO(2) DISTI_BOUND_ZERO(3) DISTI_BOUND_ZERO(4)    \
                for (; k < end; k++, m += 8) {                                                                         \
                    const size_t row = (size_t)(unsigned)*k * 8;                                                       \
                    DISTI_VEC v = DISTI_TWO(w0 + row, w2 + row), w = DISTI_TWO(w1 + row, w3 + row);                    \
                    DISTI_BOUND1(0) DISTI_BOUND1(1) DISTI_BOUND1(2) DISTI_BOUND1(3)                                    \
                    v = DISTI_ABS(v);                                                                                  \
                    w = DISTI_ABS(w);                                                                                  \
                    DISTI_BOUND1(4)                                                                                    \
                }                                                                                                      \
                DISTI_BOUND_STORE(0) DISTI_BOUND_STORE(1) DISTI_BOUND_STORE(2) DISTI_BOUND_STORE(3)                    \
                DISTI_BOUND_STORE(4)                                                                                   \
            }                                                                                                          \
        }                                                                                                              \
    }

/* disti_fit_scalar with -r beside r, so that only greatest lanes are sought. */
#define DISTI_FIT(isa)                                                                                                 \
    DISTI_NOINLINE DISTI_FUNCTION void disti_fit_##isa(const disti_fit *g)                                             \
    {                                                                                                                  \
        for (int i = 0; i < g->count; i++) {                                                                           \
            const size_t row = (size_t)(unsigned)g->list[i];                                                           \
            const float *x = g->x + row * DISTI_BLOCK, *p = g->d, *end = p + g->columns;                               \
            float *m = g->model + (size_t)(unsigned)i * 8;                                                             \
            DISTI_VEC low = DISTI_SET1(-3e38f), high = low;                                                            \
            disti_fit_slope(g, row, m);                                                                                \
            const DISTI_VEC u = DISTI_SET1(-m[1]), v = DISTI_SET1(-m[2]), w = DISTI_SET1(-m[3]);                       \
            for (; p < end; p += DISTI_LANES, x += DISTI_LANES) {                                                      \
                const DISTI_VEC p0 = DISTI_LOAD(p), p1 = DISTI_LOAD(p + DISTI_BLOCK);                                  \
                const DISTI_VEC p2 = DISTI_LOAD(p + 2 * DISTI_BLOCK);                                                  \
                DISTI_VEC r = DISTI_LOAD(x);                                                                           \
                DISTI_FMA(r, u, p0);                                                                                   \
                DISTI_FMA(r, v, p1);                                                                                   \
                DISTI_FMA(r, w, p2);                                                                                   \
                high = DISTI_GREATER(r, high);                                                                         \
                low = DISTI_GREATER(DISTI_MINUS(r), low);                                                              \
            }                                                                                                          \
            disti_fit_range(g, -disti_most_##isa(low), disti_most_##isa(high), m);                                     \
        }                                                                                                              \
    }

#define DISTI_TRANSPOSE(isa)                                                                                           \
    DISTI_FUNCTION void disti_transpose_##isa(const float *const *rows, float scale, float *to, size_t stride)         \
    {                                                                                                                  \
        for (size_t c = 0; c < DISTI_BLOCK; c += 4, to += 4 * stride)                                                  \
            for (size_t k = 0; k < 16; k += 4)                                                                         \
                DISTI_TURN(rows[k] + c, rows[k + 1] + c, rows[k + 2] + c, rows[k + 3] + c, scale, to + k, stride)      \
    }

#define DISTI_KERNELS(isa, R, W)                                                                                       \
    DISTI_GEMM_TILE(wide_##isa, R, W, DISTI_SIDE)                                                                      \
    DISTI_GEMM_TILE(middle_##isa, R, 2, DISTI_SIDE)                                                                    \
    DISTI_GEMM_TILE(narrow_##isa, 8, 1, DISTI_SIDE)                                                                    \
    DISTI_SOME_TILE(wide_##isa, R, W)                                                                                  \
    DISTI_SOME_TILE(middle_##isa, R, 2)                                                                                \
    DISTI_SOME_TILE(narrow_##isa, 8, 1)                                                                                \
    DISTI_BACK_TILE(wide_##isa, R, W, DISTI_LISTED)                                                                    \
    DISTI_BACK_TILE(middle_##isa, R, 2, DISTI_LISTED)                                                                  \
    DISTI_BACK_TILE(narrow_##isa, 8, 1, DISTI_LISTED)                                                                  \
    DISTI_BACK_TILE(next_##isa, R, W, DISTI_NEXT)                                                                      \
    DISTI_WEIGHTS_TILE(wide_##isa, R, W)                                                                               \
    DISTI_WEIGHTS_TILE(middle_##isa, R, 2)                                                                             \
    DISTI_WEIGHTS_TILE(narrow_##isa, 8, 1)                                                                             \
    DISTI_LAST_LAYER(isa)                                                                                              \
    DISTI_BOUND(isa)                                                                                                   \
    DISTI_FIT(isa)                                                                                                     \
    DISTI_TRANSPOSE(isa)                                                                                               \
    DISTI_RELU_ROWS(isa)                                                                                               \
    DISTI_PLAIN(isa, DISTI_LOOPS DISTI_FUNCTION)                                                                       \
    DISTI_DRIVERS(isa, R, W)

/* The eight entries of a list that begin at n; beyond its end the last one again. */
static const int *disti_listed(const int *list, int count, int n, int *eight)
{
    for (int i = 0; i < 8; i++) eight[i] = list[DISTI_MIN(n + i, count - 1)];
    return eight;
}

/* The eight rows of d_x that begin at the list's entry n. */
static const int *disti_back_rows(const disti_gemm_back *g, int rows, int n, int *k)
{
    if (g->alive_rows) return disti_listed(g->alive_rows, rows, n, k);
    for (int i = 0; i < 8; i++) k[i] = DISTI_MIN(n + i, rows - 1);
    return k;
}

#define DISTI_LANES ((int)(sizeof(DISTI_VEC) / sizeof(float)))
/* These are AVX-512's affair: elsewhere all tiles are the same, and a vector is no more than a panel. */
#define DISTI_TALL(isa)
#define DISTI_FEW(isa)
#define DISTI_DEPTH 112
#define DISTI_TWO(p, q) ((void)(q), DISTI_LOAD(p))
#define DISTI_TWO_STORE(p, q, v) (void)(q); DISTI_STORE(p, v);

#ifdef DISTI_X86
#define DISTI_PREFETCH(p) _mm_prefetch(p, _MM_HINT_T0)
/* An instruction on operands 1 and 2 to 0, as AT&T orders them and, with -masm=intel, as Intel does. */
#define DISTI_ORDERS(name) "{" name " %1, %2, %0|" name " %0, %2, %1}"
/* Four vectors of four, scaled: their lanes side by side to four rows. */
#define DISTI_TURN(p, q, r, t, scale, to, stride)                                                                      \
    {                                                                                                                  \
        const __m128 s = _mm_set1_ps(scale);                                                                           \
        __m128 a0 = _mm_mul_ps(s, _mm_loadu_ps(p)), a1 = _mm_mul_ps(s, _mm_loadu_ps(q));                               \
        __m128 a2 = _mm_mul_ps(s, _mm_loadu_ps(r)), a3 = _mm_mul_ps(s, _mm_loadu_ps(t));                               \
        _MM_TRANSPOSE4_PS(a0, a1, a2, a3);                                                                             \
        _mm_storeu_ps(to, a0);                                                                                         \
        _mm_storeu_ps((to) + (stride), a1);                                                                            \
        _mm_storeu_ps((to) + 2 * (stride), a2);                                                                        \
        _mm_storeu_ps((to) + 3 * (stride), a3);                                                                        \
    }

/* Of these words the sets differ in the prefix of the intrinsic alone, DISTI_MM. */
#define DISTI_SET1(s) DISTI_MM(set1_ps)(s)
#define DISTI_LOAD(p) DISTI_MM(loadu_ps)(p)
#define DISTI_STORE(p, v) DISTI_MM(storeu_ps)(p, v)
#define DISTI_ADD(a, b) DISTI_MM(add_ps)(a, b)
#define DISTI_GREATER(a, b) DISTI_MM(max_ps)(a, b)
#define DISTI_RELU(v) DISTI_GREATER(DISTI_MM(setzero_ps)(), v)
#define DISTI_ABS(v) DISTI_MM(andnot_ps)(DISTI_SET1(-0.0f), v)
#define DISTI_MINUS(v) DISTI_MM(xor_ps)(DISTI_SET1(-0.0f), v)

#define DISTI_FUNCTION DISTI_TARGET("sse2") DISTI_KERNEL static
#define DISTI_VEC __m128
#define DISTI_MM(name) _mm_##name
#define DISTI_FMA(c, a, b) c = _mm_add_ps(_mm_mul_ps(a, b), c)
#define DISTI_POSITIVE(v) (unsigned)_mm_movemask_ps(_mm_cmpnle_ps(v, _mm_setzero_ps()))
#define DISTI_KEEP(v, bits) disti_keep_sse2(v, (int)((bits) & 0xf))
DISTI_FUNCTION __m128 disti_keep_sse2(__m128 v, int bits)
{
    const __m128i lane = _mm_setr_epi32(1, 2, 4, 8);
    return _mm_and_ps(v, _mm_castsi128_ps(_mm_cmpeq_epi32(_mm_and_si128(_mm_set1_epi32(bits), lane), lane)));
}
#define DISTI_MOST4(q)                                                                                                 \
    q = _mm_max_ps(q, _mm_movehl_ps(q, q));                                                                            \
    return _mm_cvtss_f32(_mm_max_ss(q, _mm_shuffle_ps(q, q, 1)));
DISTI_FUNCTION float disti_most_sse2(__m128 v) { DISTI_MOST4(v) }
DISTI_KERNELS(sse2, 4, 2)
DISTI_FEW_TILE(four_sse2, 4, 2)
#undef DISTI_FUNCTION
#undef DISTI_VEC
#undef DISTI_MM
#undef DISTI_FMA
#undef DISTI_POSITIVE
#undef DISTI_KEEP

#define DISTI_FUNCTION DISTI_TARGET("avx2,fma") DISTI_KERNEL static
#define DISTI_VEC __m256
#define DISTI_MM(name) _mm256_##name
#ifdef _MSC_VER
#define DISTI_FMA(c, a, b) c = DISTI_MM(fmadd_ps)(a, b, c)
#else
#define DISTI_FMA(c, a, b) __asm__(DISTI_ORDERS("vfmadd231ps") : "+v"(c) : "v"(b), "v"(a))
#endif
#define DISTI_POSITIVE(v) (unsigned)_mm256_movemask_ps(_mm256_cmp_ps(v, _mm256_setzero_ps(), _CMP_NLE_UQ))
#define DISTI_KEEP(v, bits) disti_keep_avx2(v, (int)((bits) & 0xff))
DISTI_FUNCTION __m256 disti_keep_avx2(__m256 v, int bits)
{
    const __m256i lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i both = _mm256_and_si256(_mm256_set1_epi32(bits), lane);
    return _mm256_and_ps(v, _mm256_castsi256_ps(_mm256_cmpeq_epi32(both, lane)));
}
DISTI_FUNCTION float disti_most_avx2(__m256 v)
{
    __m128 q = _mm_max_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
    DISTI_MOST4(q)
}
DISTI_KERNELS(avx2, 4, 3)
DISTI_FEW_TILE(two_avx2, 2, 4)
DISTI_FEW_TILE(four_avx2, 4, 2)
DISTI_FEW_TILE(six_avx2, 6, 2)
DISTI_FEW_TILE(eight_avx2, 8, 1)
static void disti_few_avx2(const disti_few *g)
{
    if (g->points <= 2) disti_few_two_avx2(g);
    else if (g->points <= 4) disti_few_four_avx2(g);
    else if (g->points <= 6) disti_few_six_avx2(g);
    else disti_few_eight_avx2(g);
}
static const disti_part disti_parts_avx2[] = {{9, 18, 6}, {25, 30, 24}, {33, 40, 24}, {0, 0, 0}};
#undef DISTI_GREATER
#undef DISTI_TWO
#undef DISTI_TWO_STORE
#undef DISTI_TALL
#undef DISTI_FEW
#undef DISTI_DEPTH
#undef DISTI_FUNCTION
#undef DISTI_VEC
#undef DISTI_MM
#undef DISTI_POSITIVE
#undef DISTI_KEEP

#define DISTI_FUNCTION DISTI_TARGET("avx512f,avx512bw,avx512dq,avx512vl,fma") DISTI_KERNEL static
#define DISTI_VEC __m512
#define DISTI_MM(name) _mm512_##name
/* Unmasked, gcc 12 warns in C++ that its own header uses an uninitialized variable. */
#define DISTI_GREATER(a, b) _mm512_maskz_max_ps((__mmask16)0xffff, a, b)
#define DISTI_POSITIVE(v) _mm512_cmp_ps_mask(v, _mm512_setzero_ps(), _CMP_NLE_UQ)
#define DISTI_KEEP(v, bits) _mm512_maskz_mov_ps((__mmask16)((bits) & 0xffff), v)
#define DISTI_DEPTH 512
/* Eight sums are too few to hide the latency of a multiply-add. */
#define DISTI_TALL(isa)                                                                                                \
    for (; g->columns <= DISTI_LANES && first + 16 <= out; first += 16)                                                \
        disti_gemm_tall_##isa(g, first, 0, from, to, ahead);
DISTI_GEMM_TILE(tall_avx512, 16, 1, DISTI_ABOVE)
#define DISTI_FEW(isa)                                                                                                 \
    if (rows > 0 && rows <= 4 && g->columns > 2 * DISTI_LANES) {                                                       \
        disti_back_few_##isa(g, disti_back_rows(g, rows, 0, k), 0, rows, 0, from, to);                                 \
        continue;                                                                                                      \
    }
DISTI_BACK_TILE(few_avx512, 4, 3, DISTI_LISTED)
DISTI_FUNCTION float disti_most_avx512(__m512 v)
{
    const __m256 half = _mm256_max_ps(_mm512_maskz_extractf32x8_ps((__mmask8)0xff, v, 0),
                                      _mm512_maskz_extractf32x8_ps((__mmask8)0xff, v, 1));
    __m128 q = _mm_max_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
    DISTI_MOST4(q)
}
#define DISTI_TWO(p, q) \
    _mm512_maskz_insertf32x8((__mmask16)0xffff, _mm512_castps256_ps512(_mm256_loadu_ps(p)), _mm256_loadu_ps(q), 1)
#define DISTI_TWO_STORE(p, q, v) \
    _mm256_storeu_ps(p, _mm512_maskz_extractf32x8_ps((__mmask8)0xff, v, 0)); \
    _mm256_storeu_ps(q, _mm512_maskz_extractf32x8_ps((__mmask8)0xff, v, 1));
DISTI_KERNELS(avx512, 8, 3)
DISTI_FEW_TILE(two_avx512, 2, 4)
DISTI_FEW_TILE(four_avx512, 4, 4)
DISTI_FEW_TILE(six_avx512, 6, 4)
DISTI_FEW_TILE(eight_avx512, 8, 2)
DISTI_FEW_TILE(ten_avx512, 10, 2)
DISTI_FEW_TILE(twelve_avx512, 12, 2)
static void disti_few_avx512(const disti_few *g)
{
    if (g->points <= 2) disti_few_two_avx512(g);
    else if (g->points <= 4) disti_few_four_avx512(g);
    else if (g->points <= 6) disti_few_six_avx512(g);
    else if (g->points <= 8) disti_few_eight_avx512(g);
    else if (g->points <= 10) disti_few_ten_avx512(g);
    else disti_few_twelve_avx512(g);
}
static const disti_part disti_parts_avx512[] = {{13, 24, 12}, {33, 44, 32}, {49, 56, 32},
                                                {57, 60, 48}, {61, 1 << 30, 32}, {0, 0, 0}};

#ifdef DISTI_HALF
/* A hidden layer in 16 bits: f16 by AVX512-FP16, or pairs of inputs by AVX512-BF16, from one text as above. A vector's
   32-bit lanes hold two points of one row (f16) or one point's values in two rows (bf16), so a step is a row or a pair,
   its 192 bytes carry 96 points or 48, and its factors are a weight twice or the weights of the pair: 32 bits that
   broadcast without a shuffle. f32 sums begin with the bias and the point's columns, which stay in f32; f16 adds to
   them after every DISTI_SHORT steps, dead ones included, so its roundings do not pile up and leaving out what is zero
   for the whole block changes no bit.
   forward   y = activation(bias + sum_j point_weights(o, j) points[j] + sum_k weights(o, k) x[k])     k alive
   Steps of y that are not zero everywhere are appended to y_alive. bad: a sum was not finite. */
typedef struct disti_half {
    const float *weights;    /* panels (out / 8, steps, 8) of 32 bits */
    const float *point_weights, *bias; /* point_weights: of the first panel, (point, 8) */
    const float *points[2];  /* (point, B) of the first and second 48 columns */
    const float *x;          /* (steps, B) of 32 bits */
    const int *alive;        /* NULL: all steps */
    float *y;                /* (steps, B) of 32 bits */
    float *last[2];          /* instead of y, unless NULL: (out, B) in f32, the first and second 48 columns */
    int *y_alive;
    void (*activate)(int activation, float scale, size_t n, float *y, float *slope); /* NULL: ReLU */
    float scale;
    size_t panel;            /* floats from one panel of point_weights to the next */
    int activation, steps, alive_count, point, out, columns, y_alive_count, bad;
} disti_half;

/* Words besides those above: DISTI_ROWS rows in a step; DISTI_STEPS_BEGIN, how a run's sums begin (of bf16 with bias
   and point, with which those of an f16 tile begin); DISTI_FLUSH1, what becomes of them; DISTI_FINISH, how a tile may
   end sooner. From DISTI_ROWS follow DISTI_COLUMNS, points in a row's three vectors, DISTI_SHORT, steps between
   flushes, and DISTI_SECOND, from the first to the second f32 vector of one of 16 bits, which disti_narrow_ makes. */
#define DISTI_COLUMNS (2 * DISTI_BLOCK / DISTI_ROWS)
#define DISTI_SHORT (DISTI_ROWS == 1 ? 128 : 1 << 30)
#define DISTI_SECOND (DISTI_ROWS == 1 ? 16 : DISTI_COLUMNS)
#define DISTI_CELL(c) ((c) / DISTI_BLOCK)
#define DISTI_BAD(v) _mm512_fpclass_ps_mask(v, 0x99) /* NaN, infinity */
#define DISTI_LAST(from, v)                                                                                            \
    _mm512_storeu_ps(g->last[DISTI_CELL((from) % DISTI_COLUMNS)] +                                                     \
                         (at + (from) / DISTI_COLUMNS) * DISTI_BLOCK + (from) % DISTI_COLUMNS % DISTI_BLOCK, v)
#define DISTI_FLUSH(i, V) DISTI_X##V(DISTI_FLUSH1, i)
#define DISTI_HALF_TILE(kind, width, V)                                                                                \
    DISTI_NOINLINE DISTI_FUNCTION void disti_half_##width##_##kind(disti_half *g, int o)                               \
    {                                                                                                                  \
        float sums[8 * DISTI_COLUMNS];                                                                                 \
        const size_t n = V * DISTI_COLUMNS / 3, at = (size_t)(unsigned)o;                                              \
        const int *alive = g->alive, *const alive_end = alive ? alive + g->alive_count : NULL;                         \
        const float *const factors = g->point_weights + at / 8 * g->panel, *const bias = g->bias + at;                 \
        const float *const weights = g->weights + at * (size_t)(unsigned)g->steps;                                     \
        for (size_t i = 0; i < 8 && DISTI_ROWS == 1; i++) {                                                            \
            for (size_t c = 0; c < n; c += 16) {                                                                       \
                const float *p = g->points[DISTI_CELL(c)] + c % DISTI_BLOCK;                                           \
                __m512 sum = _mm512_set1_ps(bias[i]);                                                                  \
                for (size_t j = 0; j < (size_t)(unsigned)g->point; j++)                                                \
                    sum = _mm512_fmadd_ps(_mm512_set1_ps(factors[j * 8 + i]), _mm512_loadu_ps(p + j * DISTI_BLOCK),    \
                                          sum);                                                                        \
                _mm512_storeu_ps(sums + i * DISTI_COLUMNS + c, sum);                                                   \
            }                                                                                                          \
        }                                                                                                              \
        int to = 0;                                                                                                    \
        do {                                                                                                           \
            const float *w = weights + (size_t)(unsigned)to * 8, *x = g->x + (size_t)(unsigned)to * DISTI_BLOCK;       \
            to = DISTI_MIN(to + DISTI_SHORT, g->steps);                                                                \
            DISTI_STEPS_BEGIN(V)                                                                                       \
            if (alive) {                                                                                               \
                for (; alive < alive_end && *alive < to; alive++) {                                                    \
                    const size_t k = (size_t)(unsigned)*alive;                                                         \
                    DISTI_AHEAD(weights + k * 8, 256);                                                                 \
                    DISTI_STEP(8, V, DISTI_SIDE, weights + k * 8, g->x + k * DISTI_BLOCK)                              \
                }                                                                                                      \
            } else {                                                                                                   \
                const float *end = weights + (size_t)(unsigned)to * 8;                                                 \
                for (; end - w >= 2 * 8; w += 2 * 8, x += 2 * DISTI_BLOCK) {                                           \
                    DISTI_AHEAD(w, 256);                                                                               \
                    DISTI_STEP(8, V, DISTI_SIDE, w, x)                                                                 \
                    DISTI_STEP(8, V, DISTI_SIDE, w + 8, x + DISTI_BLOCK)                                               \
                }                                                                                                      \
                for (; w < end; w += 8, x += DISTI_BLOCK) DISTI_STEP(8, V, DISTI_SIDE, w, x)                           \
            }                                                                                                          \
            DISTI_FINISH(V)                                                                                            \
            DISTI_Y8(DISTI_FLUSH, V)                                                                                   \
        } while (to < g->steps);                                                                                       \
        for (size_t i = 0; i < 8 && g->activate; i++) {                                                                \
            for (size_t c = 0; c < n; c += 16) g->bad |= DISTI_BAD(_mm512_loadu_ps(sums + i * DISTI_COLUMNS + c));     \
            g->activate(g->activation, g->scale, n, sums + i * DISTI_COLUMNS, NULL);                                   \
        }                                                                                                              \
        const __m512 least = _mm512_set1_ps(g->activate ? -3.4e38f : 0.0f);                                            \
        __mmask16 bad = 0;                                                                                             \
        for (size_t i = 0; i < 8; i += DISTI_ROWS) {                                                                   \
            float *y = g->y + (at + i) / DISTI_ROWS * DISTI_BLOCK;                                                     \
            __m512i any = _mm512_setzero_si512();                                                                      \
            for (size_t j = 0; j < V; j++) {                                                                           \
                const size_t from = i * DISTI_COLUMNS + j * (DISTI_COLUMNS / 3);                                       \
                __m512 low = _mm512_loadu_ps(sums + from), high = _mm512_loadu_ps(sums + from + DISTI_SECOND);         \
                bad = (__mmask16)(bad | DISTI_BAD(low) | DISTI_BAD(high));                                             \
                low = _mm512_maskz_max_ps(0xffff, low, least);                                                         \
                high = _mm512_maskz_max_ps(0xffff, high, least);                                                       \
                if (g->last[0]) {                                                                                      \
                    DISTI_LAST(from, low);                                                                             \
                    DISTI_LAST(from + DISTI_SECOND, high);                                                             \
                    continue;                                                                                          \
                }                                                                                                      \
                const __m512i v = disti_narrow_##kind(low, high);                                                      \
                any = _mm512_or_si512(any, v);                                                                         \
                _mm512_storeu_si512((void *)(y + j * 16), v);                                                          \
            }                                                                                                          \
            if (g->last[0]) continue;                                                                                  \
            g->y_alive[g->y_alive_count] = (int)((at + i) / DISTI_ROWS);                                               \
            g->y_alive_count += (int)(at + i) < g->out && _mm512_test_epi32_mask(any, any) != 0;                       \
        }                                                                                                              \
        g->bad |= bad;                                                                                                 \
    }
#define DISTI_HALF_KERNEL(kind)                                                                                        \
    DISTI_HALF_TILE(kind, wide, 3)                                                                                     \
    DISTI_HALF_TILE(kind, middle, 2)                                                                                   \
    DISTI_HALF_TILE(kind, narrow, 1)                                                                                   \
    DISTI_FUNCTION void disti_half_##kind(disti_half *g)                                                               \
    {                                                                                                                  \
        const int vectors = (g->columns * 3 + DISTI_COLUMNS - 1) / DISTI_COLUMNS;                                      \
        for (int o = 0; o < g->out; o += 8) {                                                                          \
            if (vectors == 3) disti_half_wide_##kind(g, o);                                                            \
            else if (vectors == 2) disti_half_middle_##kind(g, o);                                                     \
            else disti_half_narrow_##kind(g, o);                                                                       \
        }                                                                                                              \
    }

#undef DISTI_FUNCTION
#undef DISTI_FMA
#define DISTI_FUNCTION DISTI_TARGET("avx512f,avx512bw,avx512dq,avx512vl,fma,avx512fp16") DISTI_KERNEL static
/* By name also because clang 14's intrinsics are there only where the whole program is built for them. */
#define DISTI_FMA(c, a, b) __asm__(DISTI_ORDERS("vfmadd231ph") : "+v"(c) : "v"(b), "v"(a))
#define DISTI_ROWS 1
#define DISTI_FLUSH1(i, j) disti_flush_f16(sums + i * DISTI_COLUMNS + j * 32, a##i##j);
#define DISTI_STEPS_BEGIN(V) DISTI_Y8(DISTI_ZERO, V)
#define DISTI_FINISH(V)
DISTI_FUNCTION void disti_flush_f16(float *sum, __m512 v)
{
    const __m512i bits = _mm512_castps_si512(v); /* parted with a mask: gcc's plain ways warn in C++ */
    const __m512 low = _mm512_maskz_cvtph_ps(0xffff, _mm512_maskz_extracti64x4_epi64(0xff, bits, 0));
    const __m512 high = _mm512_maskz_cvtph_ps(0xffff, _mm512_maskz_extracti64x4_epi64(0xff, bits, 1));
    _mm512_storeu_ps(sum, _mm512_add_ps(_mm512_loadu_ps(sum), low));
    _mm512_storeu_ps(sum + 16, _mm512_add_ps(_mm512_loadu_ps(sum + 16), high));
}
DISTI_FUNCTION __m512i disti_narrow_f16(__m512 low, __m512 high)
{
    const __m256i first = _mm512_maskz_cvtps_ph(0xffff, low, _MM_FROUND_TO_NEAREST_INT);
    const __m256i second = _mm512_maskz_cvtps_ph(0xffff, high, _MM_FROUND_TO_NEAREST_INT);
    return _mm512_maskz_inserti64x4(0xff, _mm512_castsi256_si512(first), second, 1);
}
DISTI_HALF_KERNEL(f16)

#undef DISTI_FUNCTION
#undef DISTI_FMA
#undef DISTI_ROWS
#undef DISTI_FLUSH1
#undef DISTI_STEPS_BEGIN
#undef DISTI_FINISH
#define DISTI_FUNCTION DISTI_TARGET("avx512f,avx512bw,avx512dq,avx512vl,fma,avx512bf16") DISTI_KERNEL static
#define DISTI_FMA(c, a, b) __asm__(DISTI_ORDERS("vdpbf16ps") : "+v"(c) : "v"(b), "v"(a))
#define DISTI_ROWS 2
#define DISTI_FLUSH1(i, j) _mm512_storeu_ps(sums + i * DISTI_COLUMNS + j * 16, a##i##j);
#define DISTI_BIAS1(i, j) __m512 a##i##j = b##i;
#define DISTI_BIAS(i, V) const __m512 b##i = _mm512_set1_ps(bias[i]); DISTI_X##V(DISTI_BIAS1, i)
#define DISTI_MAC32(i, j) __asm__(DISTI_ORDERS("vfmadd231ps") : "+v"(a##i##j) : "v"(x##j), "v"(b));
#define DISTI_SIDE32(i, V) { const __m512 b = _mm512_set1_ps(ws[i]); DISTI_X##V(DISTI_MAC32, i) }
/* All steps are one run, whose sums begin in registers. */
#define DISTI_STEPS_BEGIN(V)                                                                                           \
    DISTI_Y8(DISTI_BIAS, V)                                                                                            \
    for (int j = 0; j < g->point; j++) DISTI_STEP(8, V, DISTI_SIDE32, factors + j * 8, g->points[0] + j * DISTI_BLOCK)
/* Two rows, rounded to the nearest even, the first one in the low halves. */
DISTI_FUNCTION __m512i disti_narrow_bf16(__m512 low, __m512 high)
{
    const __m512i pairs = _mm512_setr_epi32(0x100000, 0x110001, 0x120002, 0x130003, 0x140004, 0x150005, 0x160006,
                                            0x170007, 0x180008, 0x190009, 0x1a000a, 0x1b000b, 0x1c000c, 0x1d000d,
                                            0x1e000e, 0x1f000f);
    __m512i both;
    __asm__(DISTI_ORDERS("vcvtne2ps2bf16") : "=v"(both) : "v"(low), "v"(high));
    return _mm512_maskz_permutexvar_epi16(0xffffffffu, pairs, both);
}
/* With ReLU the run ends in registers, too. A sum that is not finite shows in that of all; if only the latter is not,
   the block is evaluated in f32 without need. */
#define DISTI_PAIR1(i, k, j)                                                                                           \
    const __m512i v##i##j = disti_narrow_bf16(DISTI_RELU(a##i##j), DISTI_RELU(a##k##j));                               \
    _mm512_storeu_si512((void *)(y + i / 2 * DISTI_BLOCK + j * 16), v##i##j);                                          \
    any##i = _mm512_or_si512(any##i, v##i##j);                                                                         \
    all = _mm512_add_ps(all, _mm512_add_ps(a##i##j, a##k##j));
#define DISTI_PAIR(i, k, V)                                                                                            \
    __m512i any##i = _mm512_setzero_si512();                                                                           \
    DISTI_PAIRS##V(i, k)                                                                                               \
    g->y_alive[g->y_alive_count] = (int)((at + i) / 2);                                                                \
    g->y_alive_count += (int)(at + i) < g->out && _mm512_test_epi32_mask(any##i, any##i) != 0;
#define DISTI_PAIRS1(i, k) DISTI_PAIR1(i, k, 0)
#define DISTI_PAIRS2(i, k) DISTI_PAIR1(i, k, 0) DISTI_PAIR1(i, k, 1)
#define DISTI_PAIRS3(i, k) DISTI_PAIR1(i, k, 0) DISTI_PAIR1(i, k, 1) DISTI_PAIR1(i, k, 2)
#define DISTI_FINISH(V)                                                                                                \
    if (!g->activate && !g->last[0]) {                                                                                 \
        float *y = g->y + at / 2 * DISTI_BLOCK;                                                                        \
        __m512 all = _mm512_setzero_ps();                                                                              \
        DISTI_PAIR(0, 1, V) DISTI_PAIR(2, 3, V) DISTI_PAIR(4, 5, V) DISTI_PAIR(6, 7, V)                                \
        g->bad |= DISTI_BAD(all);                                                                                      \
        return;                                                                                                        \
    }
DISTI_HALF_KERNEL(bf16)
#undef DISTI_COLUMNS
#undef DISTI_ROWS
#undef DISTI_SHORT
#undef DISTI_FLUSH1
#undef DISTI_SECOND
#undef DISTI_STEPS_BEGIN
#undef DISTI_FINISH
#undef DISTI_BIAS1
#undef DISTI_BIAS
#undef DISTI_MAC32
#undef DISTI_SIDE32
#undef DISTI_PAIR
#undef DISTI_PAIR1
#undef DISTI_PAIRS1
#undef DISTI_PAIRS2
#undef DISTI_PAIRS3
#undef DISTI_CELL
#undef DISTI_BAD
#undef DISTI_LAST
#undef DISTI_FLUSH
#undef DISTI_HALF_TILE
#undef DISTI_HALF_KERNEL
#endif
#endif

#ifdef DISTI_NEON
#if defined(__GNUC__) || defined(__clang__)
#define DISTI_PREFETCH(p) __builtin_prefetch(p)
#else
#define DISTI_PREFETCH(p) __prefetch(p)
#endif

/* The factors of a tile come as lanes of two vectors instead of eight broadcasts. */
#undef DISTI_SIDE
#define DISTI_MAC_LANE(i, j) a##i##j = vfmaq_laneq_f32(a##i##j, x##j, b, (i) & 3);
#define DISTI_SIDE(i, V) { const float32x4_t b = vld1q_f32(ws + ((i) & 4)); DISTI_X##V(DISTI_MAC_LANE, i) }

#define DISTI_FUNCTION DISTI_KERNEL static
#define DISTI_VEC float32x4_t
#define DISTI_SET1(s) vdupq_n_f32(s)
#define DISTI_LOAD(p) vld1q_f32(p)
#define DISTI_STORE(p, v) vst1q_f32(p, v)
#define DISTI_ADD(a, b) vaddq_f32(a, b)
#define DISTI_FMA(c, a, b) c = vfmaq_f32(c, a, b)
#define DISTI_RELU(v) disti_positive_part(v)
#define DISTI_POSITIVE(v) disti_positive_neon(v)
#define DISTI_KEEP(v, bits) disti_keep_neon(v, (uint32_t)((bits) & 0xf))
static float32x4_t disti_positive_part(float32x4_t v)
{
    return vreinterpretq_f32_u32(vbicq_u32(vreinterpretq_u32_f32(v), vcleq_f32(v, vdupq_n_f32(0.0f))));
}
static unsigned disti_positive_neon(float32x4_t v)
{
    static const uint32_t lane[4] = {1, 2, 4, 8};
    return vaddvq_u32(vbicq_u32(vld1q_u32(lane), vcleq_f32(v, vdupq_n_f32(0.0f))));
}
static float32x4_t disti_keep_neon(float32x4_t v, uint32_t bits)
{
    static const uint32_t lane[4] = {1, 2, 4, 8};
    return vreinterpretq_f32_u32(vandq_u32(vreinterpretq_u32_f32(v), vtstq_u32(vdupq_n_u32(bits), vld1q_u32(lane))));
}
#define DISTI_GREATER(a, b) vmaxq_f32(a, b)
#define DISTI_ABS(v) vabsq_f32(v)
#define DISTI_MINUS(v) vnegq_f32(v)
#define DISTI_TURN(p, q, r, t, scale, to, stride)                                                                      \
    {                                                                                                                  \
        const float32x4x2_t a = vtrnq_f32(vmulq_n_f32(vld1q_f32(p), scale), vmulq_n_f32(vld1q_f32(q), scale));         \
        const float32x4x2_t b = vtrnq_f32(vmulq_n_f32(vld1q_f32(r), scale), vmulq_n_f32(vld1q_f32(t), scale));         \
        vst1q_f32(to, vcombine_f32(vget_low_f32(a.val[0]), vget_low_f32(b.val[0])));                                   \
        vst1q_f32((to) + (stride), vcombine_f32(vget_low_f32(a.val[1]), vget_low_f32(b.val[1])));                      \
        vst1q_f32((to) + 2 * (stride), vcombine_f32(vget_high_f32(a.val[0]), vget_high_f32(b.val[0])));                \
        vst1q_f32((to) + 3 * (stride), vcombine_f32(vget_high_f32(a.val[1]), vget_high_f32(b.val[1])));                \
    }
static float disti_most_neon(float32x4_t v) { return vmaxvq_f32(v); }
DISTI_KERNELS(neon, 8, 3)
DISTI_FEW_TILE(four_neon, 4, 2)
#endif
#endif

/* x to the nearest f16. */
#ifdef DISTI_HALF
DISTI_TARGET("f16c") static uint32_t disti_f16_bits(float x)
{
    return (uint32_t)_mm_cvtsi128_si32(_mm_cvtps_ph(_mm_set_ss(x), 0)) & 0xffff;
}
#else
static uint32_t disti_f16_bits(float x) /* not called: dist_net_set_half refuses */
{
    return (void)x, 0;
}
#endif

/* In the order of disti_kernels. */
#define DISTI_TABLE(isa, few, few_points, lone_points, parts)                                                          \
    {disti_gemm_##isa, disti_gemm_some_##isa, few, few_points, lone_points, parts, disti_bound_##isa,                  \
     disti_live_##isa, disti_fit_##isa, disti_gemm_back_##isa, disti_gemm_weights_##isa, disti_dot_##isa,              \
     disti_outer_##isa, disti_lanes_##isa, disti_rows_##isa, disti_points_##isa, disti_angles_##isa, disti_axpy_##isa, \
     disti_relu_##isa, disti_activate_##isa, disti_activate_back_##isa, disti_norm_##isa, disti_norm_few_##isa,        \
     disti_norm_back_##isa, disti_norm_tangents_##isa, disti_activate_tangents_##isa, disti_huge_##isa,                \
     disti_transpose_##isa}

/* isa: one that disti_cpu_has */
static disti_kernels disti_kernels_for(int isa)
{
#ifdef DISTI_X86
    const disti_kernels sse2 = DISTI_TABLE(sse2, disti_few_four_sse2, 4, 1, NULL);
    const disti_kernels avx2 = DISTI_TABLE(avx2, disti_few_avx2, 8, 1, disti_parts_avx2);
    const disti_kernels avx512 = DISTI_TABLE(avx512, disti_few_avx512, DISTI_FEW_POINTS, 3, disti_parts_avx512);
    if (isa != DIST_ISA_SCALAR) return isa == DIST_ISA_SSE2 ? sse2 : isa == DIST_ISA_AVX2 ? avx2 : avx512;
#endif
#ifdef DISTI_NEON
    const disti_kernels neon = DISTI_TABLE(neon, disti_few_four_neon, 4, 1, NULL);
    if (isa != DIST_ISA_SCALAR) return neon;
#endif
    const disti_kernels scalar = DISTI_TABLE(scalar, disti_few_scalar, DISTI_FEW_POINTS, 1, NULL);
    return (void)isa, scalar;
}

#undef DISTI_NOINLINE
#undef DISTI_X1
#undef DISTI_X2
#undef DISTI_X3
#undef DISTI_X4
#undef DISTI_Y1
#undef DISTI_Y2
#undef DISTI_Y4
#undef DISTI_Y6
#undef DISTI_Y8
#undef DISTI_Y10
#undef DISTI_Y12
#undef DISTI_Y16
#undef DISTI_ZERO1
#undef DISTI_AGAIN1
#undef DISTI_ZERO
#undef DISTI_AGAIN
#undef DISTI_INPUT
#undef DISTI_MAC
#undef DISTI_SIDE
#undef DISTI_APART
#undef DISTI_ABOVE
#undef DISTI_STEP
#undef DISTI_FENCE
#undef DISTI_UNROLLED
#undef DISTI_AHEAD
#undef DISTI_VECTORS
#undef DISTI_STORE_RELU1
#undef DISTI_STORE_POSITIVE1
#undef DISTI_STORE_POSITIVE
#undef DISTI_STORE_SUM1
#undef DISTI_STORE_PART1
#undef DISTI_STORE_PART
#undef DISTI_STORE_SUM
#undef DISTI_STORE_RELU
#undef DISTI_GEMM_TILE
#undef DISTI_LISTED
#undef DISTI_NEXT
#undef DISTI_RETURN1
#undef DISTI_RETURN
#undef DISTI_STORE_SOON1
#undef DISTI_STORE_SOON
#undef DISTI_STORE_KEEP1
#undef DISTI_STORE_KEEP
#undef DISTI_BACK_TILE
#undef DISTI_OUTPUT
#undef DISTI_ACCUMULATE1
#undef DISTI_ACCUMULATE
#undef DISTI_FETCH1
#undef DISTI_FETCH
#undef DISTI_WEIGHTS_TILE
#undef DISTI_OUTER1
#undef DISTI_LANES1
#undef DISTI_RELU_ROWS
#undef DISTI_PLAIN
#undef DISTI_LAST_LAYER
#undef DISTI_UNTIL
#undef DISTI_EACH
#undef DISTI_DRIVERS
#undef DISTI_KERNELS
#undef DISTI_PLACE
#undef DISTI_SOME_STORE
#undef DISTI_SOME_TILE
#undef DISTI_FEW_X
#undef DISTI_FEW_AT
#undef DISTI_FEW_INPUT
#undef DISTI_FEW_MAC
#undef DISTI_FEW_ROW
#undef DISTI_FEW_STORE1
#undef DISTI_FEW_STORE
#undef DISTI_FEW_SUM
#undef DISTI_FEW_TILE
#undef DISTI_BOUND
#undef DISTI_BOUND1
#undef DISTI_BOUND_ZERO
#undef DISTI_BOUND_STORE
#undef DISTI_FIT
#undef DISTI_TURN
#undef DISTI_TRANSPOSE
#undef DISTI_MOST4
#undef DISTI_PREFETCH
#undef DISTI_ORDERS
#undef DISTI_FUNCTION
#undef DISTI_VEC
#undef DISTI_LANES
#undef DISTI_MM
#undef DISTI_SET1
#undef DISTI_LOAD
#undef DISTI_STORE
#undef DISTI_ADD
#undef DISTI_GREATER
#undef DISTI_ABS
#undef DISTI_MINUS
#undef DISTI_TWO
#undef DISTI_TWO_STORE
#undef DISTI_FMA
#undef DISTI_RELU
#undef DISTI_POSITIVE
#undef DISTI_KEEP
#undef DISTI_TALL
#undef DISTI_FEW
#undef DISTI_DEPTH
#undef DISTI_MAC_LANE
#undef DISTI_TABLE

/* What spheres about points of one line cover of another: those about s[k], with these squares of their radii, where a
   point s lies at line[0] + s + line[1] s along the other line, and off it by the root of
   line[2] + line[3] s + line[4] s^2. n is a multiple of 4; from[k] = 3e38: the sphere does not meet it. */
static void disti_spans(const float *s, const float *square, int n, const float line[5], float *from, float *to)
{
    int k = 0;
#ifdef DISTI_X86
    const __m128 zero = _mm_setzero_ps(), none = _mm_set1_ps(3e38f), at = _mm_set1_ps(line[0]);
    const __m128 rate = _mm_set1_ps(line[1]), c0 = _mm_set1_ps(line[2]), c1 = _mm_set1_ps(line[3]);
    for (const __m128 c2 = _mm_set1_ps(line[4]); k < n; k += 4) {
        __m128 p = _mm_loadu_ps(s + k), along = _mm_add_ps(_mm_add_ps(at, p), _mm_mul_ps(rate, p));
        __m128 off = _mm_add_ps(_mm_mul_ps(_mm_add_ps(_mm_mul_ps(c2, p), c1), p), c0);
        __m128 half = _mm_sub_ps(_mm_loadu_ps(square + k), off), meets = _mm_cmpgt_ps(half, zero);
        half = _mm_sqrt_ps(_mm_max_ps(half, zero));
        _mm_storeu_ps(to + k, _mm_add_ps(along, half));
        along = _mm_sub_ps(along, half);
        _mm_storeu_ps(from + k, _mm_or_ps(_mm_and_ps(meets, along), _mm_andnot_ps(meets, none)));
    }
#endif
    for (; k < n; k++) {
        float along = line[0] + s[k] + line[1] * s[k];
        float half = square[k] - ((line[4] * s[k] + line[3]) * s[k] + line[2]);
        int meets = half > 0.0f;
        half = meets ? sqrtf(half) : 0.0f;
        from[k] = meets ? along - half : 3e38f;
        to[k] = along + half;
    }
}

/* The farthest end of the spans that begin at `end` or before, at least `end`; *next: where the first of the others
   begins, 3e38 without one. n is a multiple of 4. */
static float disti_spans_farthest(const float *from, const float *to, int n, float end, float *next)
{
    float most = end, least = 3e38f;
    int k = 0;
#ifdef DISTI_X86
    __m128 ends = _mm_set1_ps(end), none = _mm_set1_ps(3e38f), mosts = ends, leasts = none;
    for (; k < n; k += 4) {
        __m128 a = _mm_loadu_ps(from + k), b = _mm_loadu_ps(to + k), joins = _mm_cmple_ps(a, ends);
        mosts = _mm_max_ps(mosts, _mm_or_ps(_mm_and_ps(joins, b), _mm_andnot_ps(joins, ends)));
        leasts = _mm_min_ps(leasts, _mm_or_ps(_mm_and_ps(joins, none), _mm_andnot_ps(joins, a)));
    }
    mosts = _mm_max_ps(mosts, _mm_movehl_ps(mosts, mosts));
    leasts = _mm_min_ps(leasts, _mm_movehl_ps(leasts, leasts));
    most = _mm_cvtss_f32(_mm_max_ss(mosts, _mm_shuffle_ps(mosts, mosts, 1)));
    least = _mm_cvtss_f32(_mm_min_ss(leasts, _mm_shuffle_ps(leasts, leasts, 1)));
#endif
    for (; k < n; k++) {
        if (from[k] <= end) most = DISTI_MAX(most, to[k]);
        else least = DISTI_MIN(least, from[k]);
    }
    *next = least;
    return most;
}

/* Where spans end that join `end` or each other. */
static float disti_spans_end(const float *from, const float *to, int n, float end, float *next)
{
    for (float far; (far = disti_spans_farthest(from, to, n, end, next)) > end;) {
        end = far;
        if (*next > end) break; /* none of the others joins */
    }
    return end;
}

/*@ 04 field -------------------------------------------------------------------------------------------------------- */

/* b = M a and b = M^T a, 3 x 3 row-major. */
static void disti_rotate(const double m[9], const double a[3], double b[3])
{
    for (int i = 0; i < 3; i++) b[i] = m[3 * i] * a[0] + m[3 * i + 1] * a[1] + m[3 * i + 2] * a[2];
}

static void disti_rotate_back(const double m[9], const double a[3], double b[3])
{
    for (int i = 0; i < 3; i++) b[i] = m[i] * a[0] + m[3 + i] * a[1] + m[6 + i] * a[2];
}

static double disti_dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void disti_cross(const double a[3], const double b[3], double c[3])
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* Scales to unit length; 0 and leaves it alone if that cannot be done. */
DISTI_INLINE int disti_normalize(double a[3])
{
    double length = sqrt(disti_dot(a, a));
    if (!disti_finite_double(length) || length <= 1e-150) return 0;
    for (int i = 0; i < 3; i++) a[i] /= length;
    return 1;
}

/* Rows of m to the nearest frame with the first two rows' plane kept (Gram and Schmidt, third by cross product). */
static void disti_orthonormalize(double m[9])
{
    double along;
    disti_normalize(m);
    along = disti_dot(m, m + 3);
    for (int i = 0; i < 3; i++) m[3 + i] -= along * m[i];
    disti_normalize(m + 3);
    disti_cross(m, m + 3, m + 6);
}

/* How far the rows are from orthonormal, and the determinant, if they are. */
static double disti_rotation_off(const double m[9], double *determinant)
{
    double c[3], worst = 0.0;
    for (int i = 0; i < 3; i++)
        for (int j = i; j < 3; j++)
            worst = DISTI_MAX(worst, fabs(disti_dot(m + 3 * i, m + 3 * j) - (i == j ? 1.0 : 0.0)));
    disti_cross(m, m + 3, c);
    *determinant = disti_dot(c, m + 6);
    return worst;
}

/* Refuses what is not a rotation, by a sentence that takes how far it is off and the determinant. */
static dist_status disti_rotation_check(dist_context *ctx, const double m[9], const char *format, const char *function)
{
    double determinant, off = disti_rotation_off(m, &determinant);
    return off > 1e-3 || determinant < 0.0 ? disti_fail(ctx, DIST_BAD_ARGUMENT, format, function, off, determinant)
                                           : DIST_OK;
}

/* m <- exp([w]x) m by Rodrigues: exp([w]x) = I + a [w]x + b [w]x^2, a = sin|w| / |w|, b = (1 - cos|w|) / |w|^2;
   kept orthonormal. */
static void disti_turn(const float w[3], float m[9])
{
    double v[3] = {(double)w[0], (double)w[1], (double)w[2]}, r[9], s, c;
    double angle = sqrt(disti_dot(v, v));
    disti_sincos(angle, &s, &c);
    double a = angle > 1e-8 ? s / angle : 1.0, b = angle > 1e-4 ? (1.0 - c) / (angle * angle) : 0.5;
    double e[9] = {c + b * v[0] * v[0], b * v[0] * v[1] - a * v[2], b * v[0] * v[2] + a * v[1],
                   b * v[0] * v[1] + a * v[2], c + b * v[1] * v[1], b * v[1] * v[2] - a * v[0],
                   b * v[0] * v[2] - a * v[1], b * v[1] * v[2] + a * v[0], c + b * v[2] * v[2]};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            r[3 * i + j] = e[3 * i] * (double)m[j] + e[3 * i + 1] * (double)m[3 + j] + e[3 * i + 2] * (double)m[6 + j];
    disti_orthonormalize(r);
    for (int i = 0; i < 9; i++) m[i] = (float)r[i];
}

/* Of bytes in words of 4, those that are left over aside; it goes on from `hash`. */
static unsigned disti_hash(unsigned hash, size_t bytes, const void *data)
{
    uint32_t h = hash ^ 2166136261u, word;
    for (size_t i = 0; i + 4 <= bytes; i += 4) {
        memcpy(&word, (const unsigned char *)data + i, sizeof word);
        h = (h ^ word) * 2654435761u;
        h ^= h >> 15;
    }
    return h;
}

/* Analytic fields: f, grad f and the adjoint for the numbers they are made of, in one function each; q = p - center.
   At the few points where |q| or the like is 0 the gradient is 0. */
static float disti_length(float x, float y, float z)
{
    return sqrtf(x * x + y * y + z * z);
}

/* 0 of 0, and where q is so far off that squares are not finite, as -ffast-math's root of them is not, either. */
static float disti_inverse(float length)
{
    return disti_finite(length) && length > 0.0f ? 1.0f / length : 0.0f;
}

/* sphere    f = |q| - r          df/dp = q / |q|    df/dcenter = -df/dp    df/dr = -1 */
static void disti_sphere_point(const float *c, const float *p, float *f, float *g, float *d_c)
{
    float q[3] = {p[0] - c[0], p[1] - c[1], p[2] - c[2]};
    float length = disti_length(q[0], q[1], q[2]);
    float inverse = disti_inverse(length);
    *f = length - c[3];
    for (int i = 0; i < 3; i++) {
        g[i] = q[i] * inverse;
        d_c[i] = -g[i];
    }
    d_c[3] = -1.0f;
}

/* torus     h = sqrt(qx^2 + qz^2) - R,  f = sqrt(h^2 + qy^2) - r
   backward  df/dp = (h ex, qy, h ez) / sqrt(..)   df/dR = -h / sqrt(..)   df/dr = -1 */
static void disti_torus_point(const float *c, const float *p, float *f, float *g, float *d_c)
{
    float q[3] = {p[0] - c[0], p[1] - c[1], p[2] - c[2]};
    float ring = sqrtf(q[0] * q[0] + q[2] * q[2]);
    float h = ring - c[3];
    float length = sqrtf(h * h + q[1] * q[1]);
    float inverse = disti_inverse(length);
    float inverse_ring = disti_inverse(ring);
    *f = length - c[4];
    if (inverse == 0.0f) h = 0.0f;
    g[0] = h * inverse * q[0] * inverse_ring;
    g[1] = q[1] * inverse;
    g[2] = h * inverse * q[2] * inverse_ring;
    for (int i = 0; i < 3; i++) d_c[i] = -g[i];
    d_c[3] = -h * inverse;
    d_c[4] = -1.0f;
}

/* box       a = |q| - half,  f = |max(a, 0)| + min(max(a), 0)
   backward  outside: df/da = max(a, 0) / |max(a, 0)|; inside: 1 for the largest a;
             df/dp = sign(q) df/da, df/dhalf = -df/da */
static void disti_box_point(const float *c, const float *p, float *f, float *g, float *d_c)
{
    float a[3], d_a[3] = {0.0f, 0.0f, 0.0f};
    int largest = 0;
    for (int i = 0; i < 3; i++) {
        float q = p[i] - c[i];
        a[i] = (q < 0.0f ? -q : q) - c[3 + i];
        if (a[i] > a[largest]) largest = i;
    }
    float x = DISTI_MAX(a[0], 0.0f), y = DISTI_MAX(a[1], 0.0f), z = DISTI_MAX(a[2], 0.0f);
    float outside = disti_length(x, y, z);
    *f = outside + DISTI_MIN(a[largest], 0.0f);
    if (outside > 0.0f && disti_finite(outside)) {
        d_a[0] = x / outside;
        d_a[1] = y / outside;
        d_a[2] = z / outside;
    } else {
        d_a[largest] = 1.0f;
    }
    for (int i = 0; i < 3; i++) {
        g[i] = p[i] < c[i] ? -d_a[i] : d_a[i];
        d_c[i] = -g[i];
        d_c[3 + i] = -d_a[i];
    }
}

typedef void (*disti_point_fn)(const float *c, const float *p, float *f, float *g, float *d_c);

static void disti_analytic_eval(disti_point_fn point_fn, void *user, size_t n, const float *points, float *sdf,
                                float *gradient)
{
    for (size_t i = 0; i < n; i++) {
        float g[3], d_c[8];
        point_fn((const float *)user, points + 3 * i, sdf + i, g, d_c);
        if (gradient) memcpy(gradient + 3 * i, g, sizeof g);
    }
}

static void disti_analytic_adjoint(disti_point_fn point_fn, int size, void *user, size_t n, const float *points,
                                   const float *d_sdf, double *d_code)
{
    for (size_t i = 0; i < n; i++) {
        float f, g[3], d_c[8];
        point_fn((const float *)user, points + 3 * i, &f, g, d_c);
        for (int j = 0; j < size; j++) d_code[j] += (double)d_sdf[i] * (double)d_c[j];
    }
}

/* c: the numbers it is made of, `size` of them; extent: how far it reaches from its center. */
#define DISTI_ANALYTIC(name, size, extent)                                                                             \
    static void disti_##name##_eval(void *user, int worker, size_t n, const float *points, float *sdf,                 \
                                    float *gradient)                                                                   \
    {                                                                                                                  \
        (void)worker;                                                                                                  \
        disti_analytic_eval(disti_##name##_point, user, n, points, sdf, gradient);                                     \
    }                                                                                                                  \
    static void disti_##name##_adjoint(void *user, int worker, size_t n, const float *points, const float *d_sdf,      \
                                       double *d_code)                                                                 \
    {                                                                                                                  \
        (void)worker;                                                                                                  \
        disti_analytic_adjoint(disti_##name##_point, size, user, n, points, d_sdf, d_code);                            \
    }                                                                                                                  \
    static unsigned disti_##name##_changes(const dist_field *field)                                                    \
    {                                                                                                                  \
        return field->eval_fn == disti_##name##_eval ? disti_hash(0, size * sizeof(float), field->user) : 0;           \
    }                                                                                                                  \
    DIST_API dist_field dist_field_##name(const float c[size])                                                         \
    {                                                                                                                  \
        dist_field field;                                                                                              \
        union {                                                                                                        \
            const float *in;                                                                                           \
            void *out; /* user is not const, the numbers are: they are never written */                                \
        } user;                                                                                                        \
        memset(&field, 0, sizeof field);                                                                               \
        if (!c) return field;                                                                                          \
        user.in = c;                                                                                                   \
        field.user = user.out;                                                                                         \
        field.eval_fn = disti_##name##_eval;                                                                           \
        field.adjoint_fn = disti_##name##_adjoint;                                                                     \
        field.changes_fn = disti_##name##_changes;                                                                     \
        memcpy(field.center, c, sizeof field.center);                                                                  \
        field.radius = 1.1f * (extent);                                                                                \
        for (int i = 3; i < size; i++)                                                                                 \
            if (!(c[i] >= 0.0f)) field.radius = c[i]; /* no size: refused wherever the field is used */                \
        field.lipschitz = 1.0f;                                                                                        \
        field.code_size = size;                                                                                        \
        return field;                                                                                                  \
    }

DISTI_ANALYTIC(sphere, 4, c[3])
DISTI_ANALYTIC(torus, 5, c[3] + c[4])
DISTI_ANALYTIC(box, 6, disti_length(c[3], c[4], c[5]))

#define DISTI_RADIUS_LEAST 1e-15f
#define DISTI_RADIUS_MOST 1e15f

/* See 07 trace. at: for each cell by how far the center is from the surface at least, in units, rounded down; 0: not
   known to be outside. */
struct dist_cache {
    dist_context *ctx;
    dist_field field; /* without a cache */
    unsigned changes;
    int resolution;
    float corner[3], cell, inverse, unit;    /* lowest corner of the cube; a cell's side, and 1 / that; cell / 4 */
    float lipschitz, lipschitz_far;          /* what it was made with */
    unsigned char *at;                       /* (resolution, resolution, resolution), x fastest */
    unsigned long long queries;
};

static unsigned disti_changes(const dist_field *field)
{
    return field->changes_fn ? field->changes_fn(field) : 0;
}

static unsigned disti_color_changes(const dist_field *field)
{
    return field->color_changes_fn ? field->color_changes_fn(field) : 0;
}

/* What a field may be too old for. COLOR: the shape, or one of the scene's, has got another texture since it was taken;
   COUNT: the scene's weights have become more or fewer since then; FOLD and PAINT: the net's weights, or those of the
   net that colors it, have changed since dist_shape_set_code; SPHERE: an instance has left the sphere since. A shape or
   scene is looked at only where eval_fn is still its own (FOLD, SPHERE), or color_fn (COLOR, PAINT). */
enum {
    DISTI_STALE_COLOR = 1,
    DISTI_STALE_COUNT = 2,
    DISTI_STALE_FOLD = 4,
    DISTI_STALE_PAINT = 8,
    DISTI_STALE_SPHERE = 16
};

static int disti_stale(const dist_field *field, int what)
{
    return field->stale_fn ? field->stale_fn(field, what) : 0;
}

/* The figure from |f| = disti_far_from on. */
static float disti_lipschitz_far(const dist_field *field)
{
    return field->lipschitz_far > 0.0f ? field->lipschitz_far : field->lipschitz > 0.0f ? field->lipschitz : 1.0f;
}

/* The two figures for how.certified. */
static float disti_certified(const dist_field *field)
{
    return DISTI_MAX(field->lipschitz > 0.0f ? field->lipschitz : 1.0f, field->certified);
}

static float disti_certified_far(const dist_field *field)
{
    return DISTI_MAX(disti_lipschitz_far(field), field->certified_far > 0.0f ? field->certified_far : field->certified);
}

/* Whether what the cache shows to be empty is so for this field. */
static dist_status disti_cache_check(dist_context *ctx, const dist_field *field, const char *function)
{
    const dist_cache *cache = field->cache;
    const dist_field *own = &cache->field;
    float lipschitz = field->lipschitz > 0.0f ? field->lipschitz : 1.0f;
    if (cache->ctx != ctx) return disti_refuse(ctx, "%s: field.cache belongs to another context", function);
    int same = field->user == own->user && field->eval_fn == own->eval_fn && field->radius == own->radius &&
               memcmp(field->center, own->center, sizeof field->center) == 0 && field->clamp == own->clamp &&
               field->lipschitz_within == own->lipschitz_within;
    if (!same || disti_changes(field) != cache->changes)
        return disti_refuse(ctx, "%s: field.cache was made of another field, or that has changed since; see "
                                 "dist_cache_update", function);
    if (lipschitz > cache->lipschitz)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.lipschitz is %d, but field.cache was made with %d; see "
                                                  "dist_cache_update", function, (double)lipschitz,
                          (double)cache->lipschitz);
    if (disti_lipschitz_far(field) > cache->lipschitz_far)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.lipschitz_far is %d, but field.cache was made with %d; "
                                                  "see dist_cache_update", function,
                          (double)disti_lipschitz_far(field), (double)cache->lipschitz_far);
    return DIST_OK;
}

/* What makes a field unusable, for every function that takes one. */
static dist_status disti_field_check(dist_context *ctx, const dist_field *field, const char *function)
{
    if (!field) return disti_refuse(ctx, "%s: field is NULL", function);
    if (!field->eval_fn)
        return disti_refuse(ctx, "%s: field.eval_fn is NULL (a failed create, or a net without a distance channel)",
                            function);
    /* beyond these squares of lengths do not fit a float, and a surface would be missed without a word */
    if (!disti_finite(field->radius) || field->radius < DISTI_RADIUS_LEAST || field->radius > DISTI_RADIUS_MOST)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.radius is %d, must be 1e-15 to 1e15", function,
                          (double)field->radius, 0);
    for (int i = 0; i < 3; i++)
        if (!disti_finite(field->center[i]) || fabsf(field->center[i]) > DISTI_RADIUS_MOST)
            return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.center[%d] is %d, must be within 1e15 of 0", function,
                              i, (double)field->center[i]);
    const disti_limit limits[] = {
        {"field.lipschitz", (double)field->lipschitz, 0, 3e38},
        {"field.lipschitz_within", (double)field->lipschitz_within, 0, 3e38},
        {"field.detail", (double)field->detail, 0, 3e38},
        {"field.lipschitz_far", (double)field->lipschitz_far, 0, 3e38}, {"field.clamp", (double)field->clamp, 0, 3e38},
        {"field.certified", (double)field->certified, 0, 3e38},
        {"field.certified_far", (double)field->certified_far, 0, 3e38},
        {"field.cost", (double)field->cost, 0, 3e38}, {"field.code_size", (double)field->code_size, 0, 3e38},
        {"field.color_code_size", (double)field->color_code_size, 0, 3e38},
        {"field.coarse_error", (double)field->coarse_error, 0, 3e38}, {"field.noise", (double)field->noise, 0, 3e38}};
    dist_status status = disti_limits(ctx, function, sizeof limits / sizeof limits[0], limits);
    if (status != DIST_OK) return status;
    if (field->owner && field->owner != ctx) return disti_refuse(ctx, "%s: field belongs to another context", function);
    int stale = disti_stale(field, DISTI_STALE_FOLD | DISTI_STALE_SPHERE);
    if (stale)
        return disti_refuse(ctx, stale & DISTI_STALE_FOLD ? "%s: the weights of the field's net have changed since "
                                                            "dist_shape_set_code; call it again"
                                                          : "%s: dist_scene_set has brought an instance out of the "
                                                            "field's sphere; take dist_scene_field again", function);
    return field->cache ? disti_cache_check(ctx, field, function) : DIST_OK;
}

enum { DISTI_CHUNK = DISTI_SLOTS * 4 * DISTI_BLOCK }; /* points of a backward pass held at once */

/* Work is cut into pieces of whole kernel blocks, at most 2^30 of them: how does not depend on the workers. */
typedef struct disti_pieces {
    size_t n, size;
    int count;
} disti_pieces;

static disti_pieces disti_cut(size_t n, size_t size, size_t most)
{
    disti_pieces p;
    p.n = n;
    p.size = size;
    while (n / p.size >= most) p.size *= 2;
    p.count = (int)((n + p.size - 1) / p.size);
    return p;
}

/* How many points the piece has; *first: which is its first. */
static size_t disti_piece(const disti_pieces *p, int index, size_t *first)
{
    *first = (size_t)index * p->size;
    return DISTI_MIN(p->size, p->n - *first);
}

typedef struct disti_eval_job {
    const dist_field *field;
    disti_pieces pieces;
    const float *points;
    float *sdf, *gradient;
} disti_eval_job;

static void disti_eval_task(void *arg, int index, int worker)
{
    const disti_eval_job *job = (const disti_eval_job *)arg;
    size_t first, n = disti_piece(&job->pieces, index, &first);
    job->field->eval_fn(job->field->user, worker, n, job->points + 3 * first, job->sdf + first,
                        job->gradient ? job->gradient + 3 * first : NULL);
}

/* dist_field_eval behind the door. */
static void disti_field_eval_all(dist_context *ctx, const dist_field *field, size_t n, const float *points, float *sdf,
                                 float *gradient)
{
    if (n == 0) return;
    disti_eval_job job = {field, disti_cut(n, 8 * DISTI_BLOCK, 1u << 20), points, sdf, gradient};
    disti_run(ctx, job.pieces.count, disti_eval_task, &job);
}

DIST_API dist_status dist_field_eval(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                     float *sdf, float *gradient)
{
    dist_status status = disti_enter(ctx, "dist_field_eval");
    if (status == DIST_OK) status = disti_field_check(ctx, field, "dist_field_eval");
    if (status == DIST_OK) status = disti_count_check(ctx, n, "dist_field_eval");
    if (status != DIST_OK || n == 0) return status;
    if (!points || !sdf) return disti_refuse(ctx, "dist_field_eval: %s is NULL", points ? "sdf" : "points");
    disti_field_eval_all(ctx, field, n, points, sdf, gradient);
    return DIST_OK;
}

/* Colors, or their adjoint where d_color is given. */
typedef struct disti_color_job {
    const dist_field *field;
    disti_pieces pieces;
    const float *points, *d_color;
    float *color, *d_points;
    double *slots; /* (pieces.count, code_size + color_code_size) */
    int code, color_code; /* which of the two are wanted */
} disti_color_job;

static void disti_color_task(void *arg, int index, int worker)
{
    const disti_color_job *job = (const disti_color_job *)arg;
    const dist_field *field = job->field;
    size_t first, n = disti_piece(&job->pieces, index, &first);
    const float *points = job->points + 3 * first;
    if (job->color) {
        field->color_fn(field->user, worker, n, points, job->color + 3 * first);
        return;
    }
    double *d_code = job->slots + (size_t)index * ((size_t)field->code_size + (size_t)field->color_code_size);
    const float *d_color = job->d_color + 3 * first;
    float *d_points = job->d_points ? job->d_points + 3 * first : NULL;
    for (size_t i = 0, run = 0; i <= n; i++) { /* of points that are finite, and whose colors' seeds are */
        if (i < n && disti_finite_all(3, d_color + 3 * i) && disti_finite_all(3, points + 3 * i)) continue;
        if (i > run)
            field->color_adjoint_fn(field->user, worker, i - run, points + 3 * run, d_color + 3 * run,
                                    d_points ? d_points + 3 * run : NULL, job->code ? d_code : NULL,
                                    job->color_code ? d_code + field->code_size : NULL);
        run = i + 1;
    }
}

/* What makes a field's color unusable; fields without a distance are welcome here. */
static dist_status disti_color_check(dist_context *ctx, const dist_field *field, int adjoint, const char *function)
{
    if (!field) return disti_refuse(ctx, "%s: field is NULL", function);
    if (!field->color_fn || (adjoint && !field->color_adjoint_fn))
        return disti_fail(ctx, DIST_UNSUPPORTED, field->color_fn ? "%s: the field's color has no adjoint"
                                                                 : "%s: the field has no color", function, 0, 0);
    if (field->code_size < 0 || field->color_code_size < 0)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.code_size is %d, color_code_size %d, must not be negative",
                          function, field->code_size, field->color_code_size);
    if (field->owner && field->owner != ctx) return disti_refuse(ctx, "%s: field belongs to another context", function);
    int stale = disti_stale(field, DISTI_STALE_COLOR | DISTI_STALE_PAINT);
    if (stale)
        return disti_refuse(ctx, stale & DISTI_STALE_COLOR ? "%s: the field, or one in its scene, is older than its "
                                                             "shape's texture; take it anew"
                                                           : "%s: the weights of the net that colors the field have "
                                                             "changed since dist_shape_set_code; call it again",
                            function);
    return DIST_OK;
}

DIST_API dist_status dist_color_eval(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                     float *color)
{
    dist_status status = disti_enter(ctx, "dist_color_eval");
    if (status == DIST_OK) status = disti_color_check(ctx, field, 0, "dist_color_eval");
    if (status == DIST_OK) status = disti_count_check(ctx, n, "dist_color_eval");
    if (status != DIST_OK || n == 0) return status;
    if (!points || !color) return disti_refuse(ctx, "dist_color_eval: %s is NULL", points ? "color" : "points");
    disti_color_job job = {field, disti_cut(n, 8 * DISTI_BLOCK, 1u << 20), points, NULL, color, NULL, NULL, 0, 0};
    disti_run(ctx, job.pieces.count, disti_color_task, &job);
    return DIST_OK;
}

/* adjoint_fn of the points that add something: neither they nor their seeds are NaN or infinite. */
static void disti_field_adjoint(const dist_field *field, int worker, size_t n, const float *points, const float *d_sdf,
                                double *d_code)
{
    for (size_t i = 0, first = 0; i <= n; i++) {
        if (i < n && disti_finite(d_sdf[i]) && disti_finite_all(3, points + 3 * i)) continue;
        if (i > first)
            field->adjoint_fn(field->user, worker, i - first, points + 3 * first, d_sdf + first, d_code);
        first = i + 1;
    }
}

/* Value, gradient, seeds and code adjoint of any field: fused where it can, else block by block. */
static void disti_field_fused(const dist_field *field, int worker, size_t n, const float *points, dist_seed_fn seed_fn,
                              void *seed_user, double *d_code)
{
    if (field->fused_fn) {
        field->fused_fn(field->user, worker, n, points, NULL, NULL, seed_fn, seed_user, d_code);
        return;
    }
    for (size_t at = 0; at < n; at += DISTI_BLOCK) {
        float sdf[DISTI_BLOCK], gradient[3 * DISTI_BLOCK], d_sdf[DISTI_BLOCK];
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_BLOCK);
        field->eval_fn(field->user, worker, count, points + 3 * at, sdf, gradient);
        seed_fn(seed_user, at, count, sdf, gradient, d_sdf);
        if (d_code) disti_field_adjoint(field, worker, count, points + 3 * at, d_sdf, d_code);
    }
}

#ifndef DIST_NO_BACKWARD
/* Where the weights of the color's net go: a texture's, or the shape's own. */
static float *disti_color_weights(const dist_field *field, const dist_gradients *grads)
{
    if (!field->color_weights_fn) return NULL;
    return field->color_weight_count > 0 ? grads->color_weights : grads->weights;
}

/* dist_color_backward behind the door: total (code_size + color_code_size), in double and in slot order, gets those of
   the codes that grads wants. ctx->partial is large enough. */
static void disti_color_backward_all(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                     const float *d_color, float *d_points, const dist_gradients *grads, double *total)
{
    size_t size = (size_t)field->code_size + (size_t)field->color_code_size;
    float *weights = disti_color_weights(field, grads);
    int codes = grads->code || grads->color_code;
    if (n == 0 || (!d_points && !codes && !weights)) return;
    if (weights) {
        field->color_weights_fn(field->user, ctx, n, points, d_color, d_points, codes ? total : NULL, weights);
        return;
    }
    disti_color_job job = {field, disti_cut(n, DISTI_BLOCK, DISTI_SLOTS), points, d_color, NULL, d_points,
                           ctx->partial, grads->code != NULL, grads->color_code != NULL};
    memset(ctx->partial, 0, (size_t)job.pieces.count * size * sizeof(double));
    disti_run(ctx, job.pieces.count, disti_color_task, &job);
    for (size_t i = 0; codes && i < (size_t)job.pieces.count * size; i++) total[i % size] += ctx->partial[i];
}

/* One slot's share of dist_field_backward; d_code holds the slot's own sums. */
typedef struct disti_backward_job {
    const dist_field *field;
    const float *points;
    const float *directions; /* not NULL: second_fn's */
    float *d_sdf;
    dist_seed_fn seed_fn;
    void *seed_user;
    float *d_points;
    double *d_code; /* (pieces.count, code_size) or NULL */
    disti_pieces pieces;
} disti_backward_job;

/* The part of a piece that a seed call is about. */
typedef struct disti_backward_piece {
    const disti_backward_job *job;
    size_t first;
} disti_backward_piece;

/* d += s g, of three numbers each. */
DISTI_LOOPS static void disti_add_scaled(size_t n, const float *DISTI_RESTRICT s, const float *DISTI_RESTRICT g,
                                         float *DISTI_RESTRICT d)
{
    for (; n >= 4; n -= 4, s += 4, g += 12, d += 12) {
        float each[12];
        for (int i = 0; i < 12; i++) each[i] = s[i / 3];
        for (int i = 0; i < 12; i++) d[i] += each[i] * g[i];
    }
    for (size_t i = 0; i < 3 * n; i++) d[i] += s[i / 3] * g[i];
}

static void disti_backward_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                                float *d_sdf)
{
    const disti_backward_piece *piece = (const disti_backward_piece *)user;
    const disti_backward_job *job = piece->job;
    size_t at = piece->first + first;
    if (job->seed_fn) job->seed_fn(job->seed_user, at, count, sdf, gradient, d_sdf);
    else memcpy(d_sdf, job->d_sdf + at, count * sizeof(float));
    if (job->seed_fn && job->d_sdf) memcpy(job->d_sdf + at, d_sdf, count * sizeof(float));
    if (!job->d_points || !gradient) return;
    const float *p = job->points + 3 * at;
    float *d = job->d_points + 3 * at;
    if (disti_finite_all(count, d_sdf) && disti_finite_all(3 * count, gradient) && disti_finite_all(3 * count, p)) {
        disti_add_scaled(count, d_sdf, gradient, d);
        return;
    }
    for (size_t i = 0; i < count; i++)
        if (disti_finite(d_sdf[i]) && disti_finite_all(3, gradient + 3 * i) && disti_finite_all(3, p + 3 * i))
            disti_add_scaled(1, d_sdf + i, gradient + 3 * i, d + 3 * i);
}

static void disti_backward_task(void *arg, int index, int worker)
{
    const disti_backward_job *job = (const disti_backward_job *)arg;
    const dist_field *field = job->field;
    disti_backward_piece piece = {job, 0};
    size_t n = disti_piece(&job->pieces, index, &piece.first);
    double *d_code = job->d_code ? job->d_code + (size_t)index * (size_t)field->code_size : NULL;
    const float *points = job->points + 3 * piece.first;
    if (job->directions) {
        field->second_fn(field->user, worker, n, points, job->directions + 3 * piece.first,
                         job->d_points ? job->d_points + 3 * piece.first : NULL, d_code);
        return;
    }
    disti_field_fused(field, worker, n, points, disti_backward_seed, &piece, d_code);
}

/* Runs job over its n points: d_code in double, partial sums in slot order. ctx->partial is large enough. */
static void disti_backward_run(dist_context *ctx, disti_backward_job *job, size_t n, double *d_code)
{
    size_t size = (size_t)job->field->code_size;
    if (n == 0) return;
    int cheap = job->field->cost > 0.0f && job->field->cost < 5e4f; /* to which its code's sums add a few percent */
    job->pieces = disti_cut(n, (cheap ? 8 : 4) * DISTI_BLOCK, DISTI_SLOTS);
    job->d_code = d_code ? ctx->partial : NULL;
    if (d_code) memset(ctx->partial, 0, (size_t)job->pieces.count * size * sizeof(double));
    disti_run(ctx, job->pieces.count, disti_backward_task, job);
    if (!d_code) return;
    for (size_t slot = 0; slot < (size_t)job->pieces.count; slot++)
        for (size_t j = 0; j < size; j++) d_code[j] += ctx->partial[slot * size + j];
}

/* dist_field_backward behind the door. */
static void disti_field_backward_all(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                     float *d_sdf, dist_seed_fn seed_fn, void *seed_user, float *d_points,
                                     double *d_code)
{
    disti_backward_job job = {field, points, NULL, d_sdf, seed_fn, seed_user, d_points, NULL, {0, 0, 0}};
    disti_backward_run(ctx, &job, n, d_code);
}

/* Between traces the tracer's part of the first worker's scratch is free: room for 21 floats a point of a chunk. */
static float *disti_chunk_scratch(const dist_context *ctx)
{
    return (float *)(void *)(disti_scratch(ctx, 0) + DISTI_COUNTER_BYTES);
}

/* Adjoint of s_i = u_i . grad f(p_i), u the directions: adds H u to d_points, ds/dcode and ds/dweights; each may be
   NULL. stencil
      0      exact, by the field's callbacks: at most DISTI_CHUNK points
      2, 6   by differences over h = delta, seeds on f at so many points around each: at most DISTI_CHUNK * 3 / stencil
             s = |u| (f(p + h u^) - f(p - h u^)) / (2 h), u^ = u / |u|, or
             s = sum_k u_k (f(p + h e_k) - f(p - h e_k)) / (2 h) */
static dist_status disti_field_second(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                      const float *directions, size_t stencil, float delta, float *d_points,
                                      double *d_code, float *d_weights)
{
    dist_status status = DIST_OK;
    if (stencil == 0 && d_weights)
        return field->second_weights_fn(field->user, ctx, n, points, directions, d_points, d_code, d_weights);
    if (stencil == 0) {
        disti_backward_job job = {field, points, directions, NULL, NULL, NULL, d_points, NULL, {0, 0, 0}};
        disti_backward_run(ctx, &job, n, d_code);
        return status;
    }
    size_t count = n * stencil;
    float *moved = disti_chunk_scratch(ctx), *seeds = moved + 3 * count, *pulls = d_points ? seeds + count : NULL;
    for (size_t i = 0; i < count; i++) {
        const float *u = directions + i / stencil * 3, *p = points + i / stencil * 3;
        size_t axis = i % stencil / 2;
        double square = (double)u[0] * (double)u[0] + (double)u[1] * (double)u[1] + (double)u[2] * (double)u[2];
        double length = sqrt(square), h = (double)(i % 2 ? -delta : delta); /* of 1e-30 and 1e30, too */
        for (size_t k = 0; k < 3; k++) {
            double along = length > 0.0 ? h / length * (double)u[k] : 0.0, one = k == axis ? h : 0.0;
            moved[3 * i + k] = p[k] + (float)(stencil == 6 ? one : along);
        }
        seeds[i] = (float)((stencil == 6 ? (double)u[axis] : length) / (2.0 * h));
    }
    if (pulls) memset(pulls, 0, 3 * count * sizeof(float));
    if (d_weights)
        status = field->weights_fn(field->user, ctx, count, moved, seeds, NULL, NULL, pulls, d_code, d_weights);
    else disti_field_backward_all(ctx, field, count, moved, seeds, NULL, NULL, pulls, d_code);
    for (size_t i = 0; pulls && i < 3 * count; i++) d_points[i / (3 * stencil) * 3 + i % 3] += pulls[i];
    return status;
}

static dist_status disti_gradients_check(dist_context *ctx, const dist_field *field, const dist_gradients *grads,
                                         const char *function)
{
    if (!grads) return disti_refuse(ctx, "%s: grads is NULL", function);
    if (grads->code && (field->code_size == 0 || (!field->adjoint_fn && !field->fused_fn)))
        return disti_refuse(ctx, "%s: grads.code is given, but the field has no code or no adjoint_fn", function);
    if (grads->weights && !field->weights_fn)
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: grads.weights is given, but the field has no weights_fn",
                          function, 0, 0);
    if ((grads->weights || grads->color_weights) && disti_stale(field, DISTI_STALE_COUNT))
        return disti_refuse(ctx, "%s: the scene has got a field with more or fewer weights since its field was taken; "
                                 "take it anew", function);
    if (grads->color_code && (field->color_code_size <= 0 || !field->color_adjoint_fn))
        return disti_refuse(ctx, "%s: grads.color_code is given, but the field has no color code or color_adjoint_fn",
                            function);
    if (grads->color_weights && (field->color_weight_count == 0 || !field->color_weights_fn))
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: grads.color_weights is given, but the field has no texture",
                          function, 0, 0);
    return DIST_OK;
}

/* 1 if a camera's gradient is wanted. */
static int disti_gradients_camera(const dist_gradients *grads)
{
    return grads->rotation || grads->translation || grads->focal || grads->principal;
}

/* disti_gradients_check where there is neither camera nor color. */
static dist_status disti_gradients_plain(dist_context *ctx, const dist_field *field, const dist_gradients *grads,
                                         const char *function)
{
    dist_status status = disti_gradients_check(ctx, field, grads, function);
    if (status != DIST_OK || (!disti_gradients_camera(grads) && !grads->color_code && !grads->color_weights))
        return status;
    return disti_refuse(ctx, "%s: what grads holds of camera and color must be NULL: there is none here", function);
}

/* total: of the code, then of the color's code. */
static void disti_codes_add(const dist_field *field, const dist_gradients *grads, const double *total)
{
    for (int j = 0; grads->code && j < field->code_size; j++) disti_add_within(&grads->code[j], total[j]);
    for (int j = 0; grads->color_code && j < field->color_code_size; j++)
        disti_add_within(&grads->color_code[j], total[field->code_size + j]);
}

DIST_API dist_status dist_color_backward(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                         const float *d_color, float *d_points, const dist_gradients *grads)
{
    const char *name = "dist_color_backward";
    dist_gradients mine;
    dist_status status = disti_enter(ctx, name);
    if (status == DIST_OK) status = disti_color_check(ctx, field, 1, name);
    if (status == DIST_OK) status = disti_count_check(ctx, n, name);
    if (status == DIST_OK && !grads) status = disti_refuse(ctx, "%s: grads is NULL", name);
    if (status != DIST_OK) return status;
    if (disti_gradients_camera(grads))
        return disti_refuse(ctx, "%s: what grads holds of the camera must be NULL", name);
    if (grads->weights && (field->color_weight_count > 0 || !field->color_weights_fn))
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: grads.weights is given, but the color is not of the shape's net",
                          name, 0, 0);
    if (grads->code && field->code_size == 0)
        return disti_refuse(ctx, "%s: grads.code is given, but the field has no code", name);
    mine = *grads;
    mine.code = mine.weights = NULL; /* a texture by itself has both, but no adjoint_fn, weights_fn of a distance */
    status = disti_gradients_check(ctx, field, &mine, name);
    if (status != DIST_OK || n == 0) return status;
    if (!points || !d_color) return disti_refuse(ctx, "dist_color_backward: %s is NULL", points ? "d_color" : "points");
    size_t size = (size_t)field->code_size + (size_t)field->color_code_size;
    status = disti_partial_for(ctx, size);
    if (status != DIST_OK) return status;
    double *total = ctx->partial + (size_t)DISTI_SLOTS * size;
    memset(total, 0, size * sizeof(double));
    disti_color_backward_all(ctx, field, n, points, d_color, d_points, grads, total);
    disti_codes_add(field, grads, total);
    return DIST_OK;
}

/* Sums for the code are kept in double until they are added: in one more slot than the pieces use. NULL: not wanted. */
static dist_status disti_code_begin(dist_context *ctx, const dist_field *field, const dist_gradients *grads,
                                    double **d_code)
{
    size_t size = (size_t)field->code_size;
    *d_code = NULL;
    if (!grads->code) return DIST_OK;
    dist_status status = disti_partial_for(ctx, size);
    if (status != DIST_OK) return status;
    *d_code = ctx->partial + (size_t)DISTI_SLOTS * size;
    memset(*d_code, 0, size * sizeof(double));
    return DIST_OK;
}

/* name: of the function that failures are told of. */
static dist_status disti_field_backward(dist_context *ctx, const char *name, const dist_field *field, size_t n,
                                        const float *points, float *d_sdf, dist_seed_fn seed_fn, void *seed_user,
                                        float *d_points, const dist_gradients *grads)
{
    dist_status status = disti_enter(ctx, name);
    if (status == DIST_OK) status = disti_field_check(ctx, field, name);
    if (status == DIST_OK) status = disti_count_check(ctx, n, name);
    if (status == DIST_OK) status = disti_gradients_plain(ctx, field, grads, name);
    if (status != DIST_OK || n == 0) return status;
    if (!points) return disti_refuse(ctx, "%s: points is NULL", name);
    if (!d_sdf && (!seed_fn || grads->weights))
        return disti_refuse(ctx, "%s: d_sdf is NULL, needed without seed_fn and for weights", name);
    double *d_code;
    status = disti_code_begin(ctx, field, grads, &d_code);
    if (status != DIST_OK) return status;
    if (grads->weights)
        status = field->weights_fn(field->user, ctx, n, points, d_sdf, seed_fn, seed_user, d_points, d_code,
                                   grads->weights);
    else
        disti_field_backward_all(ctx, field, n, points, d_sdf, seed_fn, seed_user, d_points, d_code);
    if (status == DIST_OK) disti_codes_add(field, grads, d_code);
    return status;
}

DIST_API dist_status dist_field_backward(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                         float *d_sdf, dist_seed_fn seed_fn, void *seed_user, float *d_points,
                                         const dist_gradients *grads)
{
    const char *name = "dist_field_backward";
    return disti_field_backward(ctx, name, field, n, points, d_sdf, seed_fn, seed_user, d_points, grads);
}

/* forward   L = w / n sum_i (|g_i| - 1)^2,  g = grad f
   backward  dL/dg_i = u_i = 2 w / n (1 - 1 / |g_i|) g_i, and on from there the adjoint of u_i . grad f(p_i), u held */
DIST_API dist_status dist_field_eikonal(dist_context *ctx, const dist_field *field, size_t n, const float *points,
                                        float weight, float *loss, const dist_gradients *grads)
{
    const char *name = "dist_field_eikonal";
    double *d_code = NULL, sum = 0.0;
    dist_status status = disti_enter(ctx, name);
    if (status == DIST_OK) status = disti_field_check(ctx, field, name);
    if (status == DIST_OK) status = disti_count_check(ctx, n, name);
    if (status == DIST_OK && grads) status = disti_gradients_plain(ctx, field, grads, name);
    if (status == DIST_OK && n == 0 && loss) *loss = 0.0f;
    if (status != DIST_OK || n == 0) return status;
    if (!points) return disti_refuse(ctx, "%s: points is NULL", name);
    if (!disti_finite(weight))
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: weight is %d, must be finite", name, (double)weight, 0);
    if (grads && !grads->code && !grads->weights) grads = NULL;
    if (grads) status = disti_code_begin(ctx, field, grads, &d_code);
    int exact = field->second_fn && (!grads || !grads->weights || field->second_weights_fn);
    float *gradient = disti_chunk_scratch(ctx) + 14 * (size_t)DISTI_CHUNK, *sdf = gradient + 3 * (size_t)DISTI_CHUNK;
    float *where = sdf + (size_t)DISTI_CHUNK; /* of the points that add something */
    for (size_t at = 0; at < n && status == DIST_OK; at += DISTI_CHUNK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_CHUNK), kept = 0;
        disti_field_eval_all(ctx, field, count, points + 3 * at, sdf, gradient);
        for (size_t i = 0; i < count; i++) {
            const float *p = points + 3 * (at + i), *g = gradient + 3 * i;
            if (!disti_finite(sdf[i]) || !disti_finite_all(3, g) || !disti_finite_all(3, p)) continue;
            double v[3] = {(double)g[0], (double)g[1], (double)g[2]}, length = sqrt(disti_dot(v, v));
            double factor = length > 0.0 ? 2.0 * (double)weight * (1.0 - 1.0 / length) / (double)n : 0.0;
            sum += (length - 1.0) * (length - 1.0);
            if (factor == 0.0) continue;
            for (size_t k = 0; k < 3; k++) {
                where[3 * kept + k] = p[k];
                gradient[3 * kept + k] = disti_within_float(factor * v[k]);
            }
            kept++;
        }
        if (grads && kept > 0)
            status = disti_field_second(ctx, field, kept, where, gradient, exact ? 0 : 2, 1e-3f * field->radius, NULL,
                                        d_code, grads->weights);
    }
    if (status == DIST_OK && loss) *loss = disti_within_float((double)weight * sum / (double)n);
    if (status == DIST_OK && grads) disti_codes_add(field, grads, d_code);
    return status;
}
#endif

static int disti_is_coarse(const dist_field *field) { return field->coarse_fn && field->eval_fn == field->coarse_fn; }

/* |f| from which on lipschitz_far holds: a clamped training leaves slopes of no meaning beyond. */
static float disti_far_from(const dist_field *field)
{
    if (field->lipschitz_within > 0.0f) return field->lipschitz_within;
    return field->clamp > 0.0f ? 0.5f * field->clamp : 0.05f * field->radius;
}

/* The larger of a field's two figures. */
static float disti_steepest(const dist_field *field)
{
    float near = field->lipschitz > 0.0f ? field->lipschitz : 1.0f;
    return DISTI_MAX(near, field->lipschitz_far);
}

/* Scenes. An instance's field lives in its bounding sphere (center c, radius r), q is p in the shape's space,
   d = |q - c| - r, m = r / 5. What is asked of it stays within the sphere; outside it goes on as a lower bound of the
   distance:

     placement   x = s R q + t,   q = R^T (p - t) / s,   f_i(p) = s phi(q)
     d <= 0      b = f(q)
     0 < d       b = sqrt(d^2 + v^2),  v = max(f(c + r n), 0),  n = (q - c) / |q - c|      (a ball is convex)
     phi         min(b, m + |d - m|): continuous, no steeper than f or 1, b itself wherever b < m, and d where d >= m,
                 which needs no query
     scene       f(p) = min_i f_i(p): in order of d, instances are asked while s d is below the least value so far

   backward    grad f_i = R grad phi
               of b, d <= 0: grad b = g, df_i = s df
               of b, d > 0: grad b = (d n + v r / (r + d) (g - n (n . g))) / b, df_i = s v / b df;  g = grad f
               of the rest: grad = n sign(d - m), df_i = 0
               d log s: f - grad f . (p - t)    d w: grad f x (p - t)    d t: -grad f     with R' = exp([w]x) R,
               from dq = -q d log s - R^T (w x (p - t) + dt) / s, whatever branch phi took */
typedef struct disti_placed {
    dist_field field;
    float scale, inverse, rotation[9], translation[3]; /* inverse: 1 / scale */
    size_t code, offset; /* numbers of its field's code that have an adjoint; where they stand in the scene's */
    size_t color_offset; /* where its color code stands in the scene's */
    size_t weights[2];   /* where its weights and those of its texture stand in the scene's */
} disti_placed;

typedef struct disti_ball {
    float center[3], radius, margin; /* world */
} disti_ball;

struct dist_scene {
    dist_context *ctx;
    int count;
    disti_placed *placed;
    disti_ball *ball;
    unsigned char *scratch; /* ctx->workers times scratch_bytes */
    size_t scratch_bytes, code_size, color_code_size;
    size_t weight_count[2]; /* of the nets and of the textures; 0 where they are too many */
    unsigned changes; /* of its instances' disti_scene_mark: the same once they are what they were */
};

enum { DISTI_SCENE_CHUNK = 2048, DISTI_SCENE_PIECE = DISTI_BLOCK, DISTI_CONTESTED = -2 };

/* A worker's share of a scene's memory, for a chunk of points. */
typedef struct disti_scene_work {
    unsigned long long *queries;
    int *start;    /* (count + 1): of each instance's group in order, point */
    int *order;    /* points by instance */
    float *local;  /* (n, 3): what is asked, by instance */
    float *value, *slope;
    int *choice;   /* instance to ask, -1: none */
    float *lower;  /* d of it, world */
    float *best;   /* least value so far */
    int *winner;   /* its instance */
    unsigned char *asked; /* whether it came of a query rather than from a sphere */
    int *kept;     /* the only instance that may have to be asked, -1: none, or DISTI_CONTESTED */
    float *nearest; /* lower of the winner, if it was asked */
} disti_scene_work;

static size_t disti_scene_layout(const dist_scene *scene, unsigned char *base, disti_scene_work *w)
{
    size_t at = 0, n = DISTI_SCENE_CHUNK;
    w->queries = (unsigned long long *)disti_take(base, &at, 1, sizeof(unsigned long long));
    w->start = (int *)disti_take(base, &at, (size_t)scene->count + 1, sizeof(int));
    w->order = (int *)disti_take(base, &at, n, sizeof(int));
    w->local = (float *)disti_take(base, &at, n, 3 * sizeof(float));
    w->value = (float *)disti_take(base, &at, n, sizeof(float));
    w->slope = (float *)disti_take(base, &at, n, 3 * sizeof(float));
    w->choice = (int *)disti_take(base, &at, n, sizeof(int));
    w->lower = (float *)disti_take(base, &at, n, sizeof(float));
    w->best = (float *)disti_take(base, &at, n, sizeof(float));
    w->winner = (int *)disti_take(base, &at, n, sizeof(int));
    w->asked = (unsigned char *)disti_take(base, &at, n, 1);
    w->kept = (int *)disti_take(base, &at, n, sizeof(int));
    w->nearest = (float *)disti_take(base, &at, n, sizeof(float));
    return at;
}

static unsigned char *disti_scene_scratch(const dist_scene *scene, int worker)
{
    return scene->scratch + scene->scratch_bytes * (size_t)worker;
}

static float disti_ball_distance(const disti_ball *ball, const float *p)
{
    float length = disti_length(p[0] - ball->center[0], p[1] - ball->center[1], p[2] - ball->center[2]);
    return disti_float(disti_float(length) - ball->radius);
}

/* What is asked for p: q, or where the bounding sphere is nearest to it if it lies outside. */
static void disti_placed_local(const disti_placed *placed, const float *p, int outside, float q[3])
{
    const float *m = placed->rotation, *c = placed->field.center;
    float x[3];
    for (int i = 0; i < 3; i++) x[i] = (p[i] - placed->translation[i]) * placed->inverse;
    for (int i = 0; i < 3; i++) q[i] = m[i] * x[0] + m[3 + i] * x[1] + m[6 + i] * x[2];
    if (!outside) return;
    float share = placed->field.radius / disti_length(q[0] - c[0], q[1] - c[1], q[2] - c[2]);
    for (int i = 0; i < 3; i++) q[i] = c[i] + share * (q[i] - c[i]);
}

/* Adjoint of that: y, of what is asked, becomes that of q: y <- r / |q - c| (y - n (n . y)), n = (q - c) / |q - c|. */
static void disti_placed_unproject(const disti_placed *placed, const float *p, float y[3])
{
    const float *c = placed->field.center, radius = placed->field.radius;
    float q[3], n[3];
    disti_placed_local(placed, p, 0, q);
    for (int i = 0; i < 3; i++) n[i] = q[i] - c[i];
    float away = disti_length(n[0], n[1], n[2]);
    if (!(away > radius)) return;
    float along = (n[0] * y[0] + n[1] * y[1] + n[2] * y[2]) / away;
    for (int i = 0; i < 3; i++) y[i] = radius / away * (y[i] - along * n[i] / away);
}

/* f_i at p, d from the sphere in the world, where the field answered f. */
static float disti_placed_value(const disti_placed *placed, const disti_ball *ball, float d, float f)
{
    float b = placed->scale * f, m = ball->margin;
    if (!disti_finite(b)) return b;
    if (d > 0.0f) b = sqrtf(d * d + DISTI_MAX(b, 0.0f) * DISTI_MAX(b, 0.0f));
    return DISTI_MIN(b, m + (d > m ? d - m : m - d));
}

/* df_i/df there. */
static float disti_placed_weight(const disti_placed *placed, const disti_ball *ball, float d, float f)
{
    float b = placed->scale * f, v = DISTI_MAX(b, 0.0f);
    if (!disti_finite(b)) return placed->scale;
    if (d > 0.0f) b = sqrtf(d * d + v * v);
    if (b > ball->margin + fabsf(d - ball->margin)) return 0.0f;
    return d > 0.0f ? placed->scale * (v / b) : placed->scale;
}

/* Value and weight with the gradient, from g = grad f. */
static float disti_placed_gradient(const disti_placed *placed, const disti_ball *ball, const float *p, float d, float f,
                                   const float *g, float *gradient, float *weight)
{
    const float *m = placed->rotation;
    float n[3], v = DISTI_MAX(placed->scale * f, 0.0f), value = disti_placed_value(placed, ball, d, f), along = 0.0f;
    float length = DISTI_MAX(d + ball->radius, 1e-30f);
    *weight = disti_placed_weight(placed, ball, d, f);
    for (int i = 0; i < 3; i++) {
        n[i] = (p[i] - ball->center[i]) / length;
        gradient[i] = m[3 * i] * g[0] + m[3 * i + 1] * g[1] + m[3 * i + 2] * g[2];
        along += n[i] * gradient[i];
    }
    if (!disti_finite(value)) return value;
    float b = d > 0.0f ? sqrtf(d * d + v * v) : placed->scale * f, beside = d - ball->margin;
    if (b > ball->margin + fabsf(beside)) {
        for (int i = 0; i < 3; i++) gradient[i] = beside > 0.0f ? n[i] : -n[i];
    } else if (d > 0.0f) {
        for (int i = 0; i < 3; i++)
            gradient[i] = (d * n[i] + v * ball->radius / length * (gradient[i] - n[i] * along)) / b;
    }
    return value;
}

/* The instance to ask after (lower, choice): the next by d that may hold the minimum. */
static void disti_scene_next(const dist_scene *scene, const float *p, disti_scene_work *w, size_t i)
{
    float after = w->lower[i], least = w->best[i];
    int last = w->choice[i];
    w->choice[i] = -1;
    for (int k = 0; k < scene->count; k++) {
        float d = disti_ball_distance(&scene->ball[k], p);
        if (!(d < least) || d >= scene->ball[k].margin || d < after || (d <= after && k <= last)) continue;
        w->choice[i] = k;
        w->lower[i] = least = d;
    }
}

/* The least of what is known without a query, and the first instance to ask. Returns whether there may be a second.
   No ball farther than `limit` can hold the minimum: f_i <= m + |d - m| is known beforehand. `hint`: where to begin. */
static int disti_scene_begin(const dist_scene *scene, const float *p, disti_scene_work *w, size_t i, int hint)
{
    float best = 3e38f, first = 3e38f, second = 3e38f, limit = 1e18f;
    w->choice[i] = -1;
    w->winner[i] = hint;
    w->asked[i] = 0;
    for (int k = -1; k < scene->count; k++) {
        int at = k < 0 ? hint : k;
        const disti_ball *ball = &scene->ball[at];
        float x = p[0] - ball->center[0], y = p[1] - ball->center[1], z = p[2] - ball->center[2];
        float square = x * x + y * y + z * z, reach = limit + ball->radius;
        if (square >= reach * reach || k == hint) continue;
        float d = disti_float(disti_float(sqrtf(square)) - ball->radius), m = ball->margin;
        if (d >= m) {
            if (d >= best) continue;
            best = d;
            w->winner[i] = at;
            limit = DISTI_MIN(limit, d);
            continue;
        }
        limit = DISTI_MIN(limit, m + m - d);
        second = DISTI_MIN(second, DISTI_MAX(first, d));
        if (d < first) {
            first = d;
            w->choice[i] = at;
        }
    }
    w->best[i] = disti_finite_all(3, p) ? best : p[0] + p[1] + p[2]; /* not finite either */
    w->lower[i] = first;
    if (first >= best || !disti_finite_all(3, p)) w->choice[i] = -1;
    return w->choice[i] >= 0 && second < DISTI_MIN(best, limit);
}

/* Puts the points in order of the instance that they ask, and what they ask into local. */
static void disti_scene_sort(const dist_scene *scene, size_t n, const float *points, disti_scene_work *w)
{
    memset(w->start, 0, ((size_t)scene->count + 1) * sizeof(int));
    for (size_t i = 0; i < n; i++)
        if (w->choice[i] >= 0) w->start[w->choice[i] + 1]++;
    for (int k = 0; k < scene->count; k++) w->start[k + 1] += w->start[k];
    for (size_t i = 0; i < n; i++) {
        if (w->choice[i] < 0) continue;
        const disti_placed *placed = &scene->placed[w->choice[i]];
        size_t to = (size_t)w->start[w->choice[i]]++;
        w->order[to] = (int)i;
        disti_placed_local(placed, points + 3 * i, w->lower[i] > 0.0f, w->local + 3 * to);
    }
    for (int k = scene->count; k > 0; k--) w->start[k] = w->start[k - 1];
    w->start[0] = 0;
}

/* Asks until no instance is left that may hold a point's minimum. */
static void disti_scene_rounds(const dist_scene *scene, int worker, size_t n, const float *points, disti_scene_work *w)
{
    for (;;) {
        disti_scene_sort(scene, n, points, w);
        size_t total = (size_t)w->start[scene->count];
        if (total == 0) return;
        *w->queries += total;
        for (int k = 0; k < scene->count; k++) {
            const dist_field *field = &scene->placed[k].field;
            size_t first = (size_t)w->start[k], count = (size_t)w->start[k + 1] - first;
            if (count > 0)
                field->eval_fn(field->user, worker, count, w->local + 3 * first, w->value + first, NULL);
        }
        for (size_t at = 0; at < total; at++) {
            size_t i = (size_t)w->order[at];
            int k = w->choice[i];
            float f = disti_placed_value(&scene->placed[k], &scene->ball[k], w->lower[i], w->value[at]);
            if (!disti_finite(f) || f < w->best[i]) {
                w->best[i] = f;
                w->winner[i] = k;
                w->asked[i] = 1;
                w->nearest[i] = w->lower[i];
            }
            if (w->kept[i] == DISTI_CONTESTED && disti_finite(f)) disti_scene_next(scene, points + 3 * i, w, i);
            else w->choice[i] = -1;
        }
    }
}

/* Finds what each point has to ask: everything in rounds (all: best is then f), or only where several instances may
   hold the minimum; those are left with the one that does, or none if it is a sphere. */
static void disti_scene_settle(const dist_scene *scene, int worker, size_t n, const float *points, disti_scene_work *w,
                               int all)
{
    int hint = 0;
    for (size_t i = 0; i < n; i++) {
        int contested = disti_scene_begin(scene, points + 3 * i, w, i, hint);
        hint = w->choice[i] >= 0 ? w->choice[i] : w->winner[i];
        w->kept[i] = contested ? (int)DISTI_CONTESTED : w->choice[i];
        if (!all && !contested) w->choice[i] = -1;
    }
    disti_scene_rounds(scene, worker, n, points, w);
    for (size_t i = 0; i < n && !all; i++) {
        w->choice[i] = w->kept[i];
        if (w->kept[i] != DISTI_CONTESTED) continue;
        w->choice[i] = w->asked[i] ? w->winner[i] : -1;
        w->lower[i] = w->nearest[i];
        if (w->asked[i]) w->best[i] = 3e38f;
    }
}

/* What a group of a chunk's points needs to turn its field's answers into the scene's. */
typedef struct disti_scene_link {
    const dist_scene *scene;
    disti_scene_work *work;
    const float *points;
    size_t at, group; /* the chunk's first point, the group's first place in order */
    float *sdf, *gradient;
    dist_seed_fn seed_fn;
    void *seed_user;
    double *d_code;
} disti_scene_link;

/* What a pull g = dL/dp on a point, and `own` on log s besides, add to a placement's seven numbers: nothing where one
   of them is not finite. */
static void disti_placed_pull(const disti_placed *placed, const float *p, const double g[3], double own, double *d)
{
    double r[3], torque[3];
    if (!disti_finite_all(3, p) || !disti_finite_double(own)) return;
    if (!disti_finite_double(g[0]) || !disti_finite_double(g[1]) || !disti_finite_double(g[2])) return;
    for (int k = 0; k < 3; k++) r[k] = (double)p[k] - (double)placed->translation[k];
    disti_cross(g, r, torque);
    d[0] += own - disti_dot(g, r);
    for (int k = 0; k < 3; k++) {
        d[1 + k] += torque[k];
        d[4 + k] -= g[k];
    }
}

/* Point i of the chunk is finished: value and gradient out, the seed in, the placement's share added. Returns the
   seed. */
static float disti_scene_emit(const disti_scene_link *link, size_t i, int instance, float value, const float *gradient)
{
    const disti_placed *placed = &link->scene->placed[instance];
    const float *p = link->points + 3 * i;
    float seed = 0.0f;
    if (link->sdf) link->sdf[i] = value;
    if (link->gradient) memcpy(link->gradient + 3 * i, gradient, 3 * sizeof(float));
    if (!link->seed_fn) return 0.0f;
    link->seed_fn(link->seed_user, link->at + i, 1, &value, gradient, &seed);
    if (!link->d_code || seed == 0.0f) return seed;
    double g[3];
    for (int k = 0; k < 3; k++) g[k] = (double)seed * (double)gradient[k];
    disti_placed_pull(placed, p, g, (double)seed * (double)value, link->d_code + placed->offset + placed->code);
    return seed;
}

/* A point whose minimum is the distance to a sphere. */
static void disti_scene_emit_ball(const disti_scene_link *link, size_t i)
{
    int k = link->work->winner[i];
    const disti_ball *ball = &link->scene->ball[k];
    const float *p = link->points + 3 * i;
    float n[3] = {p[0] - ball->center[0], p[1] - ball->center[1], p[2] - ball->center[2]};
    float length = disti_length(n[0], n[1], n[2]);
    for (int axis = 0; axis < 3; axis++) n[axis] /= length;
    disti_scene_emit(link, i, k, link->work->best[i], n);
}

/* dist_seed_fn of a group: f and g of its field's answers. */
static void disti_scene_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                             float *d_sdf)
{
    const disti_scene_link *link = (const disti_scene_link *)user;
    const disti_scene_work *w = link->work;
    for (size_t j = 0; j < count; j++) {
        size_t i = (size_t)w->order[link->group + first + j];
        float g[3], weight;
        int k = w->choice[i];
        float f = disti_placed_gradient(&link->scene->placed[k], &link->scene->ball[k], link->points + 3 * i,
                                        w->lower[i], sdf[j], gradient + 3 * j, g, &weight);
        d_sdf[j] = 0.0f;
        if (disti_finite(f) && f >= w->best[i]) disti_scene_emit_ball(link, i);
        else d_sdf[j] = weight * disti_scene_emit(link, i, k, f, g);
    }
}

/* dist_field.fused_fn of a scene. Values alone are settled in rounds. With gradients or seeds only the points that
   several instances may hold are; then each point asks one instance, in that field's own fused pass. */
static void disti_scene_fused(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient,
                              dist_seed_fn seed_fn, void *seed_user, double *d_code)
{
    const dist_scene *scene = (const dist_scene *)user;
    disti_scene_work w;
    disti_scene_layout(scene, disti_scene_scratch(scene, worker), &w);
    disti_scene_link link = {scene, &w, NULL, 0, 0, NULL, NULL, seed_fn, seed_user, d_code};
    for (size_t at = 0; at < n; at += DISTI_SCENE_CHUNK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_SCENE_CHUNK);
        int plain = !gradient && !seed_fn;
        link.at = at;
        link.points = points + 3 * at;
        link.sdf = sdf ? sdf + at : NULL;
        link.gradient = gradient ? gradient + 3 * at : NULL;
        disti_scene_settle(scene, worker, count, link.points, &w, plain);
        if (plain) {
            if (sdf) memcpy(sdf + at, w.best, count * sizeof(float));
            continue;
        }
        disti_scene_sort(scene, count, link.points, &w);
        *w.queries += (unsigned long long)w.start[scene->count];
        for (size_t i = 0; i < count; i++)
            if (w.choice[i] < 0) disti_scene_emit_ball(&link, i);
        for (int k = 0; k < scene->count; k++) {
            const disti_placed *placed = &scene->placed[k];
            link.group = (size_t)w.start[k];
            size_t asked = (size_t)w.start[k + 1] - link.group;
            if (asked > 0)
                disti_field_fused(&placed->field, worker, asked, w.local + 3 * link.group, disti_scene_seed, &link,
                                  d_code && placed->code > 0 ? d_code + placed->offset : NULL);
        }
    }
}

static void disti_scene_eval(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    disti_scene_fused(user, worker, n, points, sdf, gradient, NULL, NULL, NULL);
}

/* Instances that are no scenes. */
static int disti_scene_leaves(const dist_field *field)
{
    if (field->eval_fn != disti_scene_eval) return 1;
    const dist_scene *scene = (const dist_scene *)field->user;
    int leaves = 0;
    for (int k = 0; k < scene->count; k++) leaves += disti_scene_leaves(&scene->placed[k].field);
    return leaves;
}

/* Where an instance, or one of an instance, stands: x_world = scale rotation x + translation. */
typedef struct disti_chain {
    double scale, rotation[9], translation[3];
} disti_chain;

static void disti_chain_point(const disti_chain *chain, const float *p, double x[3])
{
    const double q[3] = {(double)p[0], (double)p[1], (double)p[2]};
    disti_rotate(chain->rotation, q, x);
    for (int i = 0; i < 3; i++) x[i] = chain->scale * x[i] + chain->translation[i];
}

static void disti_chain_back(const disti_chain *chain, const float *x, float q[3])
{
    double d[3], p[3];
    for (int i = 0; i < 3; i++) d[i] = (double)x[i] - chain->translation[i];
    disti_rotate_back(chain->rotation, d, p);
    for (int i = 0; i < 3; i++) q[i] = (float)(p[i] / chain->scale);
}

static disti_chain disti_chain_on(const disti_chain *chain, const disti_placed *placed)
{
    disti_chain next;
    next.scale = chain->scale * (double)placed->scale;
    disti_chain_point(chain, placed->translation, next.translation);
    for (int i = 0; i < 9; i++) {
        next.rotation[i] = 0.0;
        for (int k = 0; k < 3; k++)
            next.rotation[i] += chain->rotation[i / 3 * 3 + k] * (double)placed->rotation[3 * k + i % 3];
    }
    return next;
}

/* What a color's gradient needs. */
typedef struct disti_scene_pull {
    const float *d_color;
    float *d_points;
    double *d_code, *d_color_code;
} disti_scene_pull;

/* Back from the colors of the points j..j+count-1 in order, all of one instance, as of a pull y = dL/dp on points that
   stay where they are: dq = -q d log s - R^T (w x (p - t) + dt) / s. */
static void disti_scene_unpaint(const disti_placed *placed, int worker, const disti_scene_work *w, size_t j,
                                size_t count, const float *points, const disti_scene_pull *pull)
{
    const dist_field *field = &placed->field;
    float d_color[3 * DISTI_SCENE_PIECE], y[3 * DISTI_SCENE_PIECE];
    memset(y, 0, sizeof y);
    for (size_t i = 0; i < count; i++) memcpy(d_color + 3 * i, pull->d_color + 3 * w->order[j + i], 3 * sizeof(float));
    field->color_adjoint_fn(field->user, worker, count, w->local + 3 * j, d_color, y,
                            pull->d_code && placed->code > 0 ? pull->d_code + placed->offset : NULL,
                            pull->d_color_code && field->color_code_size > 0
                                ? pull->d_color_code + placed->color_offset : NULL);
    for (size_t i = 0; i < count; i++) {
        size_t at = 3 * (size_t)w->order[j + i];
        double g[3];
        disti_placed_unproject(placed, points + at, y + 3 * i);
        for (size_t k = 0; k < 3; k++) {
            const float *row = placed->rotation + 3 * k;
            g[k] = (double)(row[0] * y[3 * i] + row[1] * y[3 * i + 1] + row[2] * y[3 * i + 2]) / (double)placed->scale;
            if (pull->d_points) pull->d_points[at + k] += (float)g[k];
        }
        if (pull->d_code)
            disti_placed_pull(placed, points + at, g, 0.0, pull->d_code + placed->offset + placed->code);
    }
}

/* After they have settled, the points in order of the instance whose surface is nearest, which paints them. */
static void disti_scene_painters(const dist_scene *scene, size_t n, const float *points, disti_scene_work *w)
{
    for (size_t i = 0; i < n; i++) {
        if (w->choice[i] >= 0) continue;
        w->choice[i] = w->winner[i];
        w->lower[i] = 1.0f; /* outside */
    }
    disti_scene_sort(scene, n, points, w);
}

/* The color of that instance; with `back` its adjoint. */
static void disti_scene_paint(const dist_scene *scene, int worker, size_t n, const float *points, float *color,
                              const disti_scene_pull *back)
{
    disti_scene_work w;
    disti_scene_layout(scene, disti_scene_scratch(scene, worker), &w);
    for (size_t at = 0; at < n; at += DISTI_SCENE_CHUNK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_SCENE_CHUNK);
        disti_scene_pull pull = {NULL, NULL, NULL, NULL};
        if (back) {
            pull = *back;
            pull.d_color += 3 * at;
            if (pull.d_points) pull.d_points += 3 * at;
        }
        disti_scene_settle(scene, worker, count, points + 3 * at, &w, 0);
        disti_scene_painters(scene, count, points + 3 * at, &w);
        for (int k = 0; k < scene->count; k++) {
            const dist_field *field = &scene->placed[k].field;
            size_t first = (size_t)w.start[k], end = (size_t)w.start[k + 1];
            if (!back && end > first)
                field->color_fn(field->user, worker, end - first, w.local + 3 * first, w.slope + 3 * first);
            for (size_t j = first; back && j < end; j += DISTI_SCENE_PIECE)
                disti_scene_unpaint(&scene->placed[k], worker, &w, j, DISTI_MIN(end - j, (size_t)DISTI_SCENE_PIECE),
                                    points + 3 * at, &pull);
        }
        for (size_t j = 0; !back && j < count; j++)
            memcpy(color + 3 * (at + (size_t)w.order[j]), w.slope + 3 * j, 3 * sizeof(float));
    }
}

static void disti_scene_color(void *user, int worker, size_t n, const float *points, float *color)
{
    disti_scene_paint((const dist_scene *)user, worker, n, points, color, NULL);
}

static void disti_scene_color_adjoint(void *user, int worker, size_t n, const float *points, const float *d_color,
                                      float *d_points, double *d_code, double *d_color_code)
{
    disti_scene_pull pull = {d_color, d_points, d_code, d_color_code};
    disti_scene_paint((const dist_scene *)user, worker, n, points, NULL, &pull);
}

/* The scene as far as its own backward passes have to know it. */
static dist_field disti_scene_plain(dist_scene *scene)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    field.user = scene;
    field.eval_fn = disti_scene_eval;
    field.fused_fn = disti_scene_fused;
    field.color_fn = disti_scene_color;
    field.color_adjoint_fn = disti_scene_color_adjoint;
    field.code_size = (int)scene->code_size;
    field.color_code_size = (int)scene->color_code_size;
    return field;
}

#ifndef DIST_NO_TRAIN
/* Where each instance's weights stand, each net's once: where those of the last instance before it do that has it. */
static void disti_scene_lay(dist_scene *scene, int color)
{
    size_t total = 0;
    for (int k = 0; k < scene->count; k++) {
        disti_placed *placed = &scene->placed[k];
        const dist_field *f = &placed->field;
        const void *of = color ? f->color_weights_of : f->weights_of;
        size_t count = color ? f->color_weight_count : f->weight_count;
        int last = of ? k - 1 : -1;
        placed->weights[color] = total;
        if (count == 0) continue;
        for (; last >= 0; last--) {
            const dist_field *other = &scene->placed[last].field;
            if (of == (color ? other->color_weights_of : other->weights_of)) break;
        }
        if (last >= 0) placed->weights[color] = scene->placed[last].weights[color];
        else if (!disti_size_add(total, count, &total) || total > (size_t)-1 / 16) break;
    }
    scene->weight_count[color] = total > (size_t)-1 / 16 ? 0 : total;
}

/* Which instance each of a chunk's points asks, as in a backward pass, in parallel: a part of worker 0's arrays to each
   task, but for what is a worker's own. */
typedef struct disti_scene_settling {
    const dist_scene *scene;
    disti_pieces pieces;
    const float *points;
} disti_scene_settling;

static void disti_scene_settle_task(void *arg, int index, int worker)
{
    const disti_scene_settling *job = (const disti_scene_settling *)arg;
    const dist_scene *scene = job->scene;
    disti_scene_work w, all;
    size_t first, n = disti_piece(&job->pieces, index, &first);
    disti_scene_layout(scene, disti_scene_scratch(scene, worker), &w);
    disti_scene_layout(scene, disti_scene_scratch(scene, 0), &all);
    w.order = all.order + first;
    w.local = all.local + 3 * first;
    w.value = all.value + first;
    w.choice = all.choice + first;
    w.lower = all.lower + first;
    w.best = all.best + first;
    w.winner = all.winner + first;
    w.asked = all.asked + first;
    w.kept = all.kept + first;
    w.nearest = all.nearest + first;
    disti_scene_settle(scene, worker, n, job->points + 3 * first, &w, 0);
}

static void disti_scene_settle_all(const dist_scene *scene, size_t n, const float *points, disti_scene_work *w)
{
    disti_scene_settling job = {scene, disti_cut(n, 4 * DISTI_BLOCK, 1u << 20), points};
    disti_run(scene->ctx, job.pieces.count, disti_scene_settle_task, &job);
    disti_scene_layout(scene, disti_scene_scratch(scene, 0), w);
}

/* The chunk's seeds for a group's field, its first place in order. */
typedef struct disti_scene_weighing {
    const dist_scene *scene;
    const disti_scene_work *work;
    const float *d_sdf;
    size_t group;
} disti_scene_weighing;

/* dist_seed_fn of a group whose values alone are known: those of disti_scene_seed. */
static void disti_scene_weigh(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                              float *d_sdf)
{
    const disti_scene_weighing *weighing = (const disti_scene_weighing *)user;
    const disti_scene_work *w = weighing->work;
    (void)gradient;
    for (size_t j = 0; j < count; j++) {
        size_t i = (size_t)w->order[weighing->group + first + j];
        const disti_placed *placed = &weighing->scene->placed[w->choice[i]];
        const disti_ball *ball = &weighing->scene->ball[w->choice[i]];
        float f = disti_placed_value(placed, ball, w->lower[i], sdf[j]);
        int hidden = disti_finite(f) && f >= w->best[i];
        d_sdf[j] = hidden ? 0.0f : disti_placed_weight(placed, ball, w->lower[i], sdf[j]) * weighing->d_sdf[i];
    }
}

/* dist_field.weights_fn of a scene: seeds, points and codes by a backward pass over all instances, then the weights
   instance by instance. */
static dist_status disti_scene_weights(void *user, dist_context *ctx, size_t n, const float *points, float *d_sdf,
                                       dist_seed_fn seed_fn, void *seed_user, float *d_points, double *d_code,
                                       float *d_weights)
{
    dist_scene *scene = (dist_scene *)user;
    dist_field field = disti_scene_plain(scene);
    dist_status status = DIST_OK;
    disti_scene_work w;
    if (seed_fn || d_points || d_code)
        disti_field_backward_all(ctx, &field, n, points, d_sdf, seed_fn, seed_user, d_points, d_code);
    for (size_t at = 0; at < n && status == DIST_OK; at += DISTI_SCENE_CHUNK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_SCENE_CHUNK);
        disti_scene_settle_all(scene, count, points + 3 * at, &w);
        disti_scene_sort(scene, count, points + 3 * at, &w);
        disti_scene_weighing weighing = {scene, &w, d_sdf + at, 0};
        for (int k = 0; k < scene->count && status == DIST_OK; k++) {
            const disti_placed *placed = &scene->placed[k];
            const dist_field *f = &placed->field;
            size_t asked = (size_t)w.start[k + 1] - (size_t)w.start[k];
            weighing.group = (size_t)w.start[k];
            if (asked == 0 || !f->weights_fn) continue;
            *w.queries += (unsigned long long)asked;
            status = f->weights_fn(f->user, ctx, asked, w.local + 3 * weighing.group, w.value + weighing.group,
                                   disti_scene_weigh, &weighing, NULL, NULL, d_weights + placed->weights[0]);
        }
    }
    return status;
}

/* 0: its color has no weights' gradient; 1: instances have colors of their own nets, 2: textures. */
static int disti_scene_paints(const dist_scene *scene)
{
    int own = 1, textures = 1;
    for (int k = 0; k < scene->count; k++) {
        const dist_field *f = &scene->placed[k].field;
        own = own && f->color_weights_fn && f->color_weight_count == 0;
        textures = textures && f->color_weights_fn && f->color_weight_count > 0;
    }
    return own && scene->weight_count[0] > 0 ? 1 : textures && scene->weight_count[1] > 0 ? 2 : 0;
}

/* dist_field.color_weights_fn of a scene, likewise. */
static void disti_scene_color_weights(void *user, dist_context *ctx, size_t n, const float *points,
                                      const float *d_color, float *d_points, double *d_code, float *d_weights)
{
    dist_scene *scene = (dist_scene *)user;
    dist_field field = disti_scene_plain(scene);
    dist_gradients codes; /* wanted: added to d_code */
    float wanted;
    int textures = disti_scene_paints(scene) == 2;
    disti_scene_work w;
    memset(&codes, 0, sizeof codes);
    if (d_code) codes.code = codes.color_code = &wanted;
    disti_color_backward_all(ctx, &field, n, points, d_color, d_points, &codes, d_code);
    for (size_t at = 0; at < n; at += DISTI_SCENE_CHUNK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_SCENE_CHUNK);
        disti_scene_settle_all(scene, count, points + 3 * at, &w);
        disti_scene_painters(scene, count, points + 3 * at, &w);
        for (size_t j = 0; j < count; j++)
            memcpy(w.slope + 3 * j, d_color + 3 * (at + (size_t)w.order[j]), 3 * sizeof(float));
        for (int k = 0; k < scene->count; k++) {
            const disti_placed *placed = &scene->placed[k];
            size_t first = (size_t)w.start[k], asked = (size_t)w.start[k + 1] - first;
            if (asked > 0)
                placed->field.color_weights_fn(placed->field.user, ctx, asked, w.local + 3 * first, w.slope + 3 * first,
                                               NULL, NULL, d_weights + placed->weights[textures]);
        }
    }
}
#endif

/* Whether the field asks this scene, itself or through other scenes. */
static int disti_scene_within(const dist_scene *scene, const dist_field *field)
{
    if (field->eval_fn != disti_scene_eval) return 0;
    const dist_scene *other = (const dist_scene *)field->user;
    if (other == scene) return 1;
    for (int k = 0; k < other->count; k++)
        if (disti_scene_within(scene, &other->placed[k].field)) return 1;
    return 0;
}

static size_t disti_field_code(const dist_field *field)
{
    return field->adjoint_fn || field->fused_fn ? (size_t)field->code_size : 0;
}

/* Checks a placement; m: its rotation, orthonormal. */
static dist_status disti_placement_check(dist_context *ctx, const dist_similarity *s, const char *function, double m[9])
{
    double square = 0.0;
    for (int i = 0; i < 13; i++) {
        float value = i == 0 ? s->scale : i < 10 ? s->rotation[i - 1] : s->translation[i - 10];
        if (!disti_finite(value))
            return disti_fail(ctx, DIST_NOT_FINITE,
                              i == 0   ? "%s: placement.scale is %d, must be finite"
                              : i < 10 ? "%s: a number of placement.rotation is %d, must be finite"
                                       : "%s: a number of placement.translation is %d, must be finite",
                              function, (double)value, 0);
    }
    if (s->scale < 0.0f)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: placement.scale is %d, must be above 0 (0: 1)", function,
                          (double)s->scale, 0);
    for (int i = 0; i < 9; i++) {
        m[i] = (double)s->rotation[i];
        square += m[i] * m[i];
    }
    if (square == 0.0) m[0] = m[4] = m[8] = 1.0;
    dist_status status = disti_rotation_check(ctx, m, "%s: placement.rotation is not a rotation (rows off orthonormal "
                                                      "by %d, determinant %d); see dist_similarity_move", function);
    if (status == DIST_OK) disti_orthonormalize(m);
    return status;
}

/* What the scene's changes go by of instance k: which field it is and where it stands. */
static unsigned disti_scene_mark(const dist_scene *scene, int k)
{
    const disti_placed *placed = &scene->placed[k];
    unsigned hash = disti_hash((unsigned)k, sizeof placed->field.user, &placed->field.user);
    hash = disti_hash(hash, sizeof placed->field.eval_fn, &placed->field.eval_fn);
    hash = disti_hash(hash, sizeof placed->scale, &placed->scale);
    hash = disti_hash(hash, sizeof placed->rotation, placed->rotation);
    hash = disti_hash(hash, sizeof placed->translation, placed->translation);
    return disti_hash(hash, sizeof scene->ball[k], &scene->ball[k]);
}

/* Checks an instance and puts it in place k; create: there is none yet. */
static dist_status disti_scene_place(dist_scene *scene, int k, const dist_instance *instance, int create,
                                     const char *function)
{
    dist_context *ctx = scene->ctx;
    disti_placed *placed = &scene->placed[k], next = *placed;
    const dist_similarity *s = &instance->placement;
    double m[9];
    dist_status status = create || instance->field ? disti_field_check(ctx, instance->field, function) : DIST_OK;
    if (status != DIST_OK) return status;
    if (instance->field) next.field = *instance->field;
    if (!create && disti_field_code(&next.field) != placed->code)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: field.code_size is %d, must stay what it was: %d", function,
                          (double)disti_field_code(&next.field), (double)placed->code);
    if (!create && (!next.field.color_fn != !placed->field.color_fn ||
                    !next.field.color_adjoint_fn != !placed->field.color_adjoint_fn ||
                    next.field.color_code_size != placed->field.color_code_size))
        return disti_refuse(ctx, "%s: what the instance has of color must stay what it was", function);
    if (disti_scene_within(scene, &next.field)) return disti_refuse(ctx, "%s: the field is this scene's own", function);
    status = disti_placement_check(ctx, s, function, m);
    if (status != DIST_OK) return status;
    next.scale = s->scale > 0.0f ? s->scale : 1.0f;
    next.inverse = 1.0f / next.scale;
    disti_ball ball;
    for (int i = 0; i < 3; i++) {
        const float *c = next.field.center;
        double x = m[3 * i] * (double)c[0] + m[3 * i + 1] * (double)c[1] + m[3 * i + 2] * (double)c[2];
        ball.center[i] = (float)((double)next.scale * x + (double)s->translation[i]);
    }
    for (int i = 0; i < 9; i++) next.rotation[i] = (float)m[i];
    memcpy(next.translation, s->translation, sizeof next.translation);
    ball.radius = next.scale * next.field.radius;
    ball.margin = 0.2f * ball.radius;
    if (!disti_finite_all(3, ball.center) || !(ball.radius >= DISTI_RADIUS_LEAST) ||
        !(ball.radius <= DISTI_RADIUS_MOST))
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "%s: placement.scale is %d: the bounding sphere's radius is %d, must be 1e-15 to 1e15",
                          function, (double)next.scale, (double)ball.radius);
    for (int i = 0; i < 3; i++)
        if (!(fabsf(ball.center[i]) <= DISTI_RADIUS_MOST))
            return disti_fail(ctx, DIST_BAD_ARGUMENT,
                              "%s: placement.translation puts the bounding sphere's center at %d on axis %d; must be "
                              "within 1e15 of 0", function, (double)ball.center[i], (double)i);
    if (!create) scene->changes ^= disti_scene_mark(scene, k);
    *placed = next;
    scene->ball[k] = ball;
    scene->changes ^= disti_scene_mark(scene, k);
#ifndef DIST_NO_TRAIN
    for (int color = 0; color < 2 && !create && instance->field; color++) disti_scene_lay(scene, color);
#endif
    return DIST_OK;
}

DIST_API dist_status dist_scene_set(dist_scene *scene, int index, const dist_instance *instance)
{
    if (!scene) return DIST_BAD_ARGUMENT;
    if (!instance) return disti_refuse(scene->ctx, "dist_scene_set: instance is NULL", NULL);
    if (index < 0 || index >= scene->count)
        return disti_fail(scene->ctx, DIST_BAD_ARGUMENT, "dist_scene_set: index is %d, must be 0 to %d", NULL, index,
                          scene->count - 1);
    return disti_scene_place(scene, index, instance, 0, "dist_scene_set");
}

DIST_API void dist_scene_destroy(dist_scene *scene)
{
    if (!scene) return;
    size_t count = (size_t)scene->count;
    disti_free(scene->ctx, scene->scratch, scene->scratch_bytes * (size_t)scene->ctx->workers);
    disti_free(scene->ctx, scene->ball, count * sizeof(disti_ball));
    disti_free(scene->ctx, scene->placed, count * sizeof(disti_placed));
    disti_free(scene->ctx, scene, sizeof *scene);
}

/* The memory of a scene whose ctx and count are set, but for its own and its codes'. */
static dist_status disti_scene_take(dist_scene *scene)
{
    dist_context *ctx = scene->ctx;
    disti_scene_work w;
    size_t count = (size_t)scene->count;
    scene->scratch_bytes = disti_scene_layout(scene, NULL, &w);
    scene->placed = (disti_placed *)disti_alloc_array(ctx, count, sizeof(disti_placed));
    if (!scene->placed) return DIST_OUT_OF_MEMORY;
    scene->ball = (disti_ball *)disti_alloc_array(ctx, count, sizeof(disti_ball));
    if (!scene->ball) return DIST_OUT_OF_MEMORY;
    scene->scratch = (unsigned char *)disti_alloc_array(ctx, (size_t)ctx->workers, scene->scratch_bytes);
    return scene->scratch ? DIST_OK : DIST_OUT_OF_MEMORY;
}

DIST_API dist_scene *dist_scene_create(dist_context *ctx, int count, const dist_instance *instances)
{
    const char *name = "dist_scene_create";
    if (disti_enter(ctx, name) != DIST_OK) return NULL;
    if (count < 1 || count > 1 << 20) {
        disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: count is %d, must be 1 to 1048576", name, count, 0);
        return NULL;
    }
    if (!instances) {
        disti_refuse(ctx, "%s: instances is NULL", name);
        return NULL;
    }
    dist_scene *scene = (dist_scene *)disti_alloc(ctx, sizeof(dist_scene));
    if (!scene) return NULL;
    memset(scene, 0, sizeof *scene);
    scene->ctx = ctx;
    scene->count = count;
    if (disti_scene_take(scene) != DIST_OK) goto fail;
    memset(scene->scratch, 0, scene->scratch_bytes * (size_t)ctx->workers);
    memset(scene->placed, 0, (size_t)count * sizeof(disti_placed));
    for (int k = 0; k < count; k++) {
        disti_placed *placed = &scene->placed[k];
        ctx->instance = k + 1;
        dist_status status = disti_scene_place(scene, k, &instances[k], 1, name);
        ctx->instance = 0;
        if (status != DIST_OK) goto fail;
        placed->code = disti_field_code(&placed->field);
        placed->offset = scene->code_size;
        scene->code_size += placed->code + 7;
        placed->color_offset = scene->color_code_size;
        scene->color_code_size += (size_t)placed->field.color_code_size;
        if (scene->code_size + scene->color_code_size > 0x7fffffffu) {
            disti_refuse(ctx, "%s: all codes together have more than 2^31 numbers", name);
            goto fail;
        }
    }
#ifndef DIST_NO_TRAIN
    for (int color = 0; color < 2; color++) disti_scene_lay(scene, color);
#endif
    if (disti_partial_for(ctx, scene->code_size + scene->color_code_size) == DIST_OK) return scene;
fail:
    dist_scene_destroy(scene);
    return NULL;
}

/* The smallest sphere around the instances' spheres, nearly: from the middle toward the farthest, less each time
   (Badoiu and Clarkson 2003); the best center is kept. */
static float disti_scene_bound(const dist_scene *scene, float center[3])
{
    double c[3] = {0.0, 0.0, 0.0}, least = 1e300;
    for (int k = 0; k < scene->count; k++)
        for (int i = 0; i < 3; i++) c[i] += (double)scene->ball[k].center[i] / scene->count;
    for (int round = 2; round < 66; round++) {
        double most = -1.0, to[3] = {0.0, 0.0, 0.0};
        for (int k = 0; k < scene->count; k++) {
            double d[3], r = (double)scene->ball[k].radius;
            for (int i = 0; i < 3; i++) d[i] = (double)scene->ball[k].center[i] - c[i];
            double length = sqrt(disti_dot(d, d));
            if (length + r <= most) continue;
            most = length + r;
            for (int i = 0; i < 3; i++) to[i] = length > 0.0 ? d[i] * most / length : 0.0;
        }
        if (most < least) {
            least = most;
            for (int i = 0; i < 3; i++) center[i] = (float)c[i];
        }
        for (int i = 0; i < 3; i++) c[i] += to[i] / round;
    }
    return (float)(scene->count > 1 ? least * (1.0 + 1e-6) : least);
}

static unsigned disti_scene_changes(const dist_field *field)
{
    if (field->eval_fn != disti_scene_eval) return 0;
    const dist_scene *scene = (const dist_scene *)field->user;
    unsigned hash = scene->changes;
    for (int k = 0; k < scene->count; k++) {
        unsigned own = disti_changes(&scene->placed[k].field);
        hash = disti_hash(hash, sizeof own, &own);
    }
    return hash;
}

static unsigned disti_scene_color_changes(const dist_field *field)
{
    if (field->color_fn != disti_scene_color) return 0;
    const dist_scene *scene = (const dist_scene *)field->user;
    unsigned hash = 0;
    for (int k = 0; k < scene->count; k++) {
        unsigned own = disti_color_changes(&scene->placed[k].field);
        hash = disti_hash(hash, sizeof own, &own);
    }
    return hash;
}

/* Whether a ball lies in the field's sphere, but for rounding. */
static int disti_ball_within(const disti_ball *ball, const dist_field *field)
{
    double square = 0.0;
    for (int i = 0; i < 3; i++) {
        double d = (double)ball->center[i] - (double)field->center[i];
        square += d * d;
    }
    return sqrt(square) + (double)ball->radius <= (double)field->radius * (1.0 + 1e-5);
}

static int disti_scene_stale(const dist_field *field, int what)
{
    if (field->eval_fn != disti_scene_eval) what &= ~(DISTI_STALE_FOLD | DISTI_STALE_SPHERE);
    if (field->color_fn != disti_scene_color) what &= ~(DISTI_STALE_COLOR | DISTI_STALE_PAINT);
    const dist_scene *scene = (const dist_scene *)field->user;
    int moved = (what & DISTI_STALE_SPHERE) && field->taken != scene->changes;
    int stale = 0, own = what & ~DISTI_STALE_COUNT;
    for (int k = 0; own && k < scene->count; k++) {
        stale |= disti_stale(&scene->placed[k].field, own);
        if (moved && !disti_ball_within(&scene->ball[k], field)) stale |= DISTI_STALE_SPHERE;
    }
#ifndef DIST_NO_TRAIN
    if ((what & DISTI_STALE_COUNT) &&
        (field->weight_count != scene->weight_count[0] ||
         field->color_weight_count != (disti_scene_paints(scene) == 2 ? scene->weight_count[1] : 0)))
        stale |= DISTI_STALE_COUNT;
#endif
    return stale;
}

DIST_API dist_field dist_scene_field(dist_scene *scene)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    if (!scene) return field;
    field = disti_scene_plain(scene);
    field.owner = scene->ctx;
    field.changes_fn = disti_scene_changes;
    field.color_changes_fn = disti_scene_color_changes;
    field.stale_fn = disti_scene_stale;
    field.taken = scene->changes;
    field.lipschitz = field.lipschitz_far = 1.0f; /* phi outside the spheres, however flat the instances are */
    field.radius = disti_scene_bound(scene, field.center);
#ifndef DIST_NO_TRAIN
    field.weight_count = scene->weight_count[0];
    if (field.weight_count > 0) field.weights_fn = disti_scene_weights;
    if (disti_scene_paints(scene)) field.color_weights_fn = disti_scene_color_weights;
    if (disti_scene_paints(scene) == 2) field.color_weight_count = scene->weight_count[1];
    field.weights_of = field.color_weights_of = scene;
#endif
    int known = 1; /* what each instance costs */
    for (int k = 0; k < scene->count; k++) {
        const dist_field *f = &scene->placed[k].field;
        float clamp = f->clamp * scene->placed[k].scale;
        float detail = (f->detail > 0.0f ? f->detail : f->radius) * scene->placed[k].scale;
        if (!(field.detail > 0.0f && field.detail < detail)) field.detail = detail;
        float within = disti_far_from(f) * scene->placed[k].scale;
        if (!(field.lipschitz_within > 0.0f && field.lipschitz_within < within)) field.lipschitz_within = within;
        field.noise = DISTI_MAX(field.noise, f->noise * scene->placed[k].scale);
        field.lipschitz = DISTI_MAX(field.lipschitz, f->lipschitz);
        field.lipschitz_far = DISTI_MAX(field.lipschitz_far, disti_steepest(f));
        field.certified = DISTI_MAX(field.certified, f->certified);
        field.certified_far = DISTI_MAX(field.certified_far, DISTI_MAX(f->certified, f->certified_far));
        if (clamp > 0.0f && !(field.clamp > 0.0f && field.clamp < clamp)) field.clamp = clamp;
        if (disti_is_coarse(f)) {
            field.coarse_fn = field.eval_fn;
            field.coarse_error = DISTI_MAX(field.coarse_error, f->coarse_error * scene->placed[k].scale);
        }
        known = known && f->cost > 0.0f;
        field.cost = known ? DISTI_MIN(field.cost + f->cost, 2e38f) : 0.0f;
        if (!f->color_fn) field.color_fn = NULL;
        if (!f->color_adjoint_fn) field.color_adjoint_fn = NULL;
    }
    return field;
}

DIST_API int dist_scene_offset(const dist_scene *scene, int index)
{
    if (!scene || index < 0 || index > scene->count) return -1;
    return (int)(index < scene->count ? scene->placed[index].offset : scene->code_size);
}

DIST_API size_t dist_scene_weight_offset(const dist_scene *scene, int index, int color)
{
    if (!scene || index < 0 || index >= scene->count || color < 0 || color > 1) return (size_t)-1;
    return scene->placed[index].weights[color];
}

DIST_API unsigned long long dist_scene_queries(const dist_scene *scene)
{
    disti_scene_work w;
    unsigned long long sum = 0;
    for (int worker = 0; scene && worker < scene->ctx->workers; worker++) {
        disti_scene_layout(scene, disti_scene_scratch(scene, worker), &w);
        sum += *w.queries;
    }
    return sum;
}

typedef struct disti_scene_job {
    const dist_scene *scene;
    disti_pieces pieces;
    const float *points;
    int *index;
} disti_scene_job;

static void disti_scene_find_task(void *arg, int index, int worker)
{
    const disti_scene_job *job = (const disti_scene_job *)arg;
    const dist_scene *scene = job->scene;
    disti_scene_work w;
    size_t first, end = disti_piece(&job->pieces, index, &first);
    disti_scene_layout(scene, disti_scene_scratch(scene, worker), &w);
    end += first;
    for (size_t count = 0; first < end; first += count) {
        count = DISTI_MIN(end - first, (size_t)DISTI_SCENE_CHUNK);
        disti_scene_settle(scene, worker, count, job->points + 3 * first, &w, 1);
        memcpy(job->index + first, w.winner, count * sizeof(int));
    }
}

DIST_API dist_status dist_scene_find(dist_scene *scene, size_t n, const float *points, int *index)
{
    if (!scene) return DIST_BAD_ARGUMENT;
    dist_status status = disti_enter(scene->ctx, "dist_scene_find");
    if (status == DIST_OK) status = disti_count_check(scene->ctx, n, "dist_scene_find");
    if (status != DIST_OK || n == 0) return status;
    if (!points || !index) return disti_refuse(scene->ctx, "dist_scene_find: %s is NULL", points ? "index" : "points");
    for (int k = 0; k < scene->count; k++)
        if (disti_stale(&scene->placed[k].field, DISTI_STALE_FOLD))
            return disti_fail(scene->ctx, DIST_BAD_ARGUMENT, "%s: the weights of instance %d's net have changed since "
                                                             "dist_shape_set_code; call it again", "dist_scene_find",
                              k, 0);
    disti_scene_job job = {scene, disti_cut(n, DISTI_SCENE_CHUNK, 1u << 20), points, index};
    disti_run(scene->ctx, job.pieces.count, disti_scene_find_task, &job);
    return DIST_OK;
}

DIST_API void dist_similarity_move(dist_similarity *placement, const float step[7])
{
    int turned = 0;
    if (!placement || !step || !disti_finite_all(7, step)) return;
    if (placement->scale == 0.0f) placement->scale = 1.0f;
    for (int i = 0; i < 9; i++) turned |= !disti_finite(placement->rotation[i]) || placement->rotation[i] != 0.0f;
    if (!turned) placement->rotation[0] = placement->rotation[4] = placement->rotation[8] = 1.0f;
    double scale = (double)placement->scale * exp(DISTI_MIN(DISTI_MAX((double)step[0], -200.0), 200.0));
    if (placement->scale > 0.0f) placement->scale = (float)(scale < 1e-30 ? 1e-30 : scale > 1e30 ? 1e30 : scale);
    disti_turn(step + 1, placement->rotation);
    for (int i = 0; i < 3; i++) disti_add_within(&placement->translation[i], (double)step[4 + i]);
}

/*@ 05 net ---------------------------------------------------------------------------------------------------------- */

static dist_status disti_capacity(dist_context *ctx, const char *function, size_t capacity, size_t need)
{
    return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: capacity is %d, must be at least %d", function, (double)capacity,
                      (double)need);
}

typedef struct disti_writer {
    unsigned char *out; /* NULL: only counted */
    size_t size;        /* SIZE_MAX if it does not fit */
} disti_writer;

static void disti_put(disti_writer *w, const void *bytes, size_t size)
{
    if (w->out) memcpy(w->out + w->size, bytes, size);
    disti_size_add(w->size, size, &w->size);
}

/* Little-endian on every machine. */
static void disti_put_word(disti_writer *w, uint32_t x)
{
    unsigned char bytes[4];
    for (int i = 0; i < 4; i++) bytes[i] = (unsigned char)(x >> 8 * i & 255u);
    disti_put(w, bytes, sizeof bytes);
}

static void disti_put_float(disti_writer *w, float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    disti_put_word(w, bits);
}

static void disti_put_text(disti_writer *w, const char *text)
{
    disti_put(w, text, strlen(text));
}

static void disti_put_size(disti_writer *w, size_t value)
{
    char digits[24];
    disti_put(w, digits, disti_format_whole(digits, value));
}

static void disti_put_number(disti_writer *w, double x, int digits)
{
    char text[32];
    disti_put(w, text, disti_format_number(text, x, digits));
}

/* The container of a model: safetensors. Eight bytes give the header's length (little-endian), the header is a JSON
   object name -> {dtype, shape, data_offsets}, and the tensors' bytes follow without overlap or hole, in any alignment.
   The file is hostile: the header is read twice, first counted and then kept, so that one block of the exact size holds
   everything: at most 1.7 times the header and 24 bytes for each of DISTI_META_MAX metadata entries. */
enum { DISTI_DTYPE_OTHER = -1, DISTI_F32 = 0, DISTI_F16, DISTI_BF16 };
enum { DISTI_META_MAX = 65536, DISTI_HEADER_MAX = 100000000 };

typedef struct disti_tensor {
    const char *name;          /* unescaped */
    int dtype;                 /* DISTI_DTYPE_OTHER: well-formed, but not to be read: integers, doubles, rank above 4 */
    int rank;
    size_t shape[4];           /* the first four of rank */
    size_t count;              /* product of the whole shape */
    size_t bytes;              /* of data */
    const unsigned char *data; /* in the caller's bytes, unaligned */
} disti_tensor;

typedef struct disti_archive {
    disti_tensor *tensors; /* in the header's order */
    size_t tensor_count;
    const char **keys;
    const char **values;
    size_t meta_count;
    const void **order; /* the tensors by name */
    void *block;        /* holds all of the above */
    size_t block_bytes;
} disti_archive;

typedef struct disti_reader {
    dist_context *ctx;
    const char *function;
    const char *kind;          /* what a sentence is about: the file, the header, a tensor or a metadata key */
    const unsigned char *name; /* its name, name_size bytes as they stand in the file, or NULL */
    size_t name_size;
    const unsigned char *bytes, *header, *cursor, *end;
    size_t data_size;
    disti_archive *archive; /* its block is NULL while counting */
    size_t text_size;
    char *text;             /* the strings, each with its NUL; NULL while counting */
    size_t text_bytes;
} disti_reader;

/* disti_fail with "function: kind "name" " before `what`. A name is cut and cleaned, for it becomes part of the format.
   Always 0. */
static int disti_bad(const disti_reader *r, const char *what, const char *text, double a, double b)
{
    char format[400];
    disti_writer w = {(unsigned char *)format, 0};
    disti_put_text(&w, r->function);
    disti_put_text(&w, ": ");
    disti_put_text(&w, r->kind);
    disti_put_text(&w, r->name ? " \"" : " ");
    for (size_t i = 0; r->name && i < r->name_size && i < 80; i++) {
        unsigned char c = r->name[i];
        disti_put(&w, c >= ' ' && c <= '~' && c != '%' ? &c : (const unsigned char *)"?", 1);
    }
    if (r->name) disti_put_text(&w, "\" ");
    disti_put(&w, what, strlen(what) + 1);
    disti_fail(r->ctx, DIST_BAD_FILE, format, text, a, b);
    return 0;
}

/* Where the cursor stands, counted from the first byte of the file. */
static double disti_json_at(const disti_reader *r)
{
    return (double)(r->cursor - r->bytes);
}

static void disti_json_space(disti_reader *r)
{
    while (r->cursor < r->end && (*r->cursor == ' ' || *r->cursor == '\n' || *r->cursor == '\r' || *r->cursor == '\t'))
        r->cursor++;
}

/* Steps over white space and the character `must`. */
static int disti_json_expect(disti_reader *r, char must)
{
    char text[] = "'?', must be '?'";
    disti_json_space(r);
    if (r->cursor < r->end && *r->cursor == (unsigned char)must) {
        r->cursor++;
        return 1;
    }
    text[14] = must;
    if (r->cursor == r->end)
        return disti_bad(r, "is spoiled: the header ends at byte %d, must go on with %s", text + 13,
                         disti_json_at(r), 0);
    if (*r->cursor) text[1] = (char)*r->cursor;
    return disti_bad(r, "is spoiled: byte %d of the file is %s", text, disti_json_at(r), 0);
}

/* Begins an object or array: 1 an element follows, 0 it is empty, -1 failure. */
static int disti_json_open(disti_reader *r, char open, char close)
{
    if (!disti_json_expect(r, open)) return -1;
    disti_json_space(r);
    if (r->cursor == r->end || *r->cursor != (unsigned char)close) return 1;
    r->cursor++;
    return 0;
}

/* After an element: 1 another follows, 0 that was the last, -1 failure. */
static int disti_json_next(disti_reader *r, char close)
{
    disti_json_space(r);
    if (r->cursor < r->end && *r->cursor == ',') {
        r->cursor++;
        return 1;
    }
    return disti_json_expect(r, close) ? 0 : -1;
}

static int disti_json_hex(disti_reader *r, unsigned *out)
{
    *out = 0;
    for (int i = 0; i < 4; i++) {
        unsigned c = r->cursor < r->end ? *r->cursor : 0;
        unsigned letter = c | 0x20u;
        if (c >= '0' && c <= '9') *out = *out * 16 + c - '0';
        else if (letter >= 'a' && letter <= 'f') *out = *out * 16 + letter - 'a' + 10;
        else return disti_bad(r, "is spoiled: byte %d of the file must be a hexadecimal digit", NULL,
                              disti_json_at(r), 0);
        r->cursor++;
    }
    return 1;
}

/* The escape after a backslash as UTF-8: returns the number of bytes, 0 on failure. */
static int disti_json_escape(disti_reader *r, unsigned char utf8[4])
{
    static const char letters[] = "\"\\/bfnrt", meaning[] = "\"\\/\b\f\n\r\t";
    unsigned char c = r->cursor < r->end ? *r->cursor : 0;
    const char *known = (const char *)memchr(letters, c, sizeof letters - 1);
    if (known) {
        r->cursor++;
        utf8[0] = (unsigned char)meaning[known - letters];
        return 1;
    }
    if (c != 'u')
        return disti_bad(r, "is spoiled: byte %d of the file is no escape of JSON", NULL, disti_json_at(r), 0);
    unsigned code, low;
    r->cursor++;
    if (!disti_json_hex(r, &code)) return 0;
    if (code >= 0xd800u && code < 0xdc00u && r->end - r->cursor >= 2 && r->cursor[0] == '\\' && r->cursor[1] == 'u') {
        r->cursor += 2;
        if (!disti_json_hex(r, &low)) return 0;
        if (low >= 0xdc00u && low < 0xe000u) code = 0x10000u + ((code - 0xd800u) << 10) + (low - 0xdc00u);
    }
    if (code == 0 || (code >= 0xd800u && code < 0xe000u))
        return disti_bad(r, "is spoiled: the escape before byte %d of the file must not be NUL or half a surrogate "
                         "pair", NULL, disti_json_at(r), 0);
    int count = code < 0x80u ? 1 : code < 0x800u ? 2 : code < 0x10000u ? 3 : 4;
    for (int i = count - 1; i > 0; i--, code >>= 6) utf8[i] = (unsigned char)(0x80u | (code & 0x3fu));
    utf8[0] = (unsigned char)((count == 1 ? 0u : 0xf00u >> count & 0xffu) | code);
    return count;
}

/* A string, unescaped into out (cut to capacity, NUL-terminated; capacity may be 0). *length is that of the whole. */
static int disti_json_string(disti_reader *r, char *out, size_t capacity, size_t *length)
{
    size_t n = 0;
    if (!disti_json_expect(r, '"')) return 0;
    for (;;) {
        unsigned char utf8[4];
        int count = 1;
        if (r->cursor == r->end)
            return disti_bad(r, "is spoiled: a string does not end in the header", NULL, 0, 0);
        utf8[0] = *r->cursor++;
        if (utf8[0] == '"') break;
        if (utf8[0] < 0x20)
            return disti_bad(r, "is spoiled: control character %d before byte %d of the file must be escaped", NULL,
                             utf8[0], disti_json_at(r));
        if (utf8[0] == '\\') count = disti_json_escape(r, utf8);
        if (count == 0) return 0;
        for (int i = 0; i < count; i++, n++)
            if (n + 1 < capacity) out[n] = (char)utf8[i];
    }
    if (capacity) out[n < capacity ? n : capacity - 1] = 0;
    *length = n;
    return 1;
}

/* A string that the archive keeps; counting, only its room. */
static int disti_json_keep(disti_reader *r, const char **kept)
{
    size_t length;
    char *out = r->text ? r->text + r->text_size : NULL;
    if (!disti_json_string(r, out, r->text ? r->text_bytes - r->text_size : 0, &length)) return 0;
    r->text_size += length + 1;
    *kept = out;
    return 1;
}

/* A non-negative integer as JSON writes it. */
static int disti_json_size(disti_reader *r, const char *field, size_t *out)
{
    disti_json_space(r);
    const unsigned char *first = r->cursor;
    int fits = 1;
    *out = 0;
    for (; r->cursor < r->end && *r->cursor >= '0' && *r->cursor <= '9'; r->cursor++)
        fits = fits && disti_size_mul(*out, 10, out) && disti_size_add(*out, (size_t)(*r->cursor - '0'), out);
    int more = r->cursor < r->end && (*r->cursor == '.' || *r->cursor == 'e' || *r->cursor == 'E');
    if (r->cursor == first || more || (*first == '0' && r->cursor - first > 1))
        return disti_bad(r, "has in %s at byte %d of the file something that is not a plain non-negative integer",
                         field, (double)(first - r->bytes), 0);
    if (fits) return 1;
    return disti_bad(r, "has in %s at byte %d of the file a number that does not fit size_t", field,
                     (double)(first - r->bytes), 0);
}

/* An array of integers: how many, the first four, and their product, SIZE_MAX if that does not fit. */
static int disti_json_sizes(disti_reader *r, const char *field, int *rank, size_t first[4], size_t *product)
{
    int fits = 1;
    *rank = 0;
    *product = 1;
    int more = disti_json_open(r, '[', ']');
    for (; more == 1; more = disti_json_next(r, ']')) {
        size_t value;
        if (!disti_json_size(r, field, &value)) return 0;
        if (*rank < 4) first[*rank] = value;
        ++*rank;
        fits = fits && disti_size_mul(*product, value, product);
    }
    return more == 0;
}

/* The dtype's element size, 0 if there is no such dtype. */
static size_t disti_dtype_size(const char *name, int *dtype)
{
    static const struct {
        char name[12];
        size_t size;
        int dtype;
    } known[] = {{"F32", 4, DISTI_F32}, {"F16", 2, DISTI_F16}, {"BF16", 2, DISTI_BF16},
                 {"BOOL", 1, -1}, {"U8", 1, -1}, {"I8", 1, -1}, {"F8_E5M2", 1, -1}, {"F8_E4M3", 1, -1}, {"I16", 2, -1},
                 {"U16", 2, -1}, {"I32", 4, -1}, {"U32", 4, -1}, {"F64", 8, -1}, {"I64", 8, -1}, {"U64", 8, -1}};
    for (size_t i = 0; i < sizeof known / sizeof known[0]; i++) {
        if (strcmp(name, known[i].name) != 0) continue;
        *dtype = known[i].dtype;
        return known[i].size;
    }
    return 0;
}

/* The value of a tensor's name: exactly dtype, shape and data_offsets, in any order. */
static int disti_archive_tensor(disti_reader *r, disti_tensor *tensor)
{
    static const char fields[3][16] = {"dtype", "shape", "data_offsets"};
    char text[32];
    size_t length, offsets[4], product, element = 0;
    int found[3] = {0, 0, 0}, offset_count = 0;
    int more = disti_json_open(r, '{', '}');
    for (; more == 1; more = disti_json_next(r, '}')) {
        int field = 0;
        if (!disti_json_string(r, text, sizeof text, &length)) return 0;
        while (field < 3 && strcmp(text, fields[field]) != 0) field++;
        if (field == 3)
            return disti_bad(r, "has the field '%s', must have dtype, shape and data_offsets only", text, 0, 0);
        if (found[field]++) return disti_bad(r, "has the field %s twice", text, 0, 0);
        if (!disti_json_expect(r, ':')) return 0;
        if (field == 0) {
            if (!disti_json_string(r, text, sizeof text, &length)) return 0;
            element = disti_dtype_size(text, &tensor->dtype);
            if (!element) return disti_bad(r, "has the dtype '%s', must be F32, F16 or BF16", text, 0, 0);
        } else if (field == 1) {
            if (!disti_json_sizes(r, "shape", &tensor->rank, tensor->shape, &tensor->count)) return 0;
        } else if (!disti_json_sizes(r, "data_offsets", &offset_count, offsets, &product)) {
            return 0;
        }
    }
    if (more < 0) return 0;
    for (int field = 0; field < 3; field++)
        if (!found[field]) return disti_bad(r, "has no field %s", fields[field], 0, 0);
    if (offset_count != 2) return disti_bad(r, "has %d data_offsets, must be 2", NULL, offset_count, 0);
    if (offsets[0] > offsets[1] || offsets[1] > r->data_size)
        return disti_bad(r, "has data_offsets that end at %d, must be from their begin to %d, the size of the data",
                         NULL, (double)offsets[1], (double)r->data_size);
    if (tensor->count == (size_t)-1 || !disti_size_mul(tensor->count, element, &product))
        return disti_bad(r, "has a shape whose size in bytes does not fit size_t", NULL, 0, 0);
    if (product != offsets[1] - offsets[0])
        return disti_bad(r, "has %d bytes by its data_offsets, must be %d by its shape and dtype", NULL,
                         (double)(offsets[1] - offsets[0]), (double)product);
    if (tensor->rank > 4) tensor->dtype = DISTI_DTYPE_OTHER;
    tensor->bytes = product;
    tensor->data = r->end + offsets[0];
    return 1;
}

/* What the sentences are about from here on. */
static void disti_archive_about(disti_reader *r, const char *kind, const void *name, size_t name_size)
{
    r->kind = kind;
    r->name = (const unsigned char *)name;
    r->name_size = name_size;
}

/* A name and its colon. */
static int disti_archive_name(disti_reader *r, const char *kind, const char **kept)
{
    disti_archive_about(r, "the header", NULL, 0);
    disti_json_space(r);
    const unsigned char *first = r->cursor;
    if (!disti_json_keep(r, kept)) return 0;
    disti_archive_about(r, kind, first + 1, (size_t)(r->cursor - first) - 2);
    return disti_json_expect(r, ':');
}

static int disti_archive_metadata(disti_reader *r)
{
    int more = disti_json_open(r, '{', '}');
    for (; more == 1; more = disti_json_next(r, '}')) {
        const char *key, *value;
        if (!disti_archive_name(r, "metadata key", &key) || !disti_json_keep(r, &value)) return 0;
        size_t index = r->archive->meta_count++;
        if (index == DISTI_META_MAX)
            return disti_bad(r, "is one too many, there must be at most %d", NULL, DISTI_META_MAX, 0);
        if (!r->text) continue;
        r->archive->keys[index] = key;
        r->archive->values[index] = value;
    }
    return more == 0;
}

/* One pass over the header: counts and checks, and keeps where there is room. */
static int disti_archive_pass(disti_reader *r)
{
    int metadata = 0;
    r->cursor = r->header;
    r->archive->tensor_count = r->archive->meta_count = r->text_size = 0;
    disti_archive_about(r, "the header", NULL, 0);
    int more = disti_json_open(r, '{', '}');
    for (; more == 1; more = disti_json_next(r, '}')) {
        char name[32];
        size_t length;
        disti_archive_about(r, "the header", NULL, 0);
        const unsigned char *first = r->cursor;
        if (!disti_json_string(r, name, sizeof name, &length)) return 0;
        if (strcmp(name, "__metadata__") == 0) {
            if (metadata++) return disti_bad(r, "has __metadata__ twice", NULL, 0, 0);
            if (!disti_json_expect(r, ':') || !disti_archive_metadata(r)) return 0;
            continue;
        }
        disti_tensor counted;
        disti_tensor *tensor = r->text ? &r->archive->tensors[r->archive->tensor_count] : &counted;
        r->cursor = first;
        if (!disti_archive_name(r, "tensor", &tensor->name) || !disti_archive_tensor(r, tensor)) return 0;
        r->archive->tensor_count++;
    }
    if (more < 0) return 0;
    disti_archive_about(r, "the header", NULL, 0);
    disti_json_space(r);
    if (r->cursor == r->end) return 1;
    return disti_bad(r, "goes on at byte %d of the file, must have only spaces after its object", NULL,
                     disti_json_at(r), 0);
}

/* Heapsort: n log n whatever the file says, and no memory; qsort promises neither. */
static void disti_sort(size_t n, const void **items, int (*compare_fn)(const void *a, const void *b))
{
    for (size_t start = n / 2, end = n; end > 1;) {
        const void *item;
        if (start > 0) {
            item = items[--start];
        } else {
            item = items[--end];
            items[end] = items[0];
        }
        size_t root = start;
        for (size_t child = 2 * root + 1; child < end; child = 2 * root + 1) {
            if (child + 1 < end && compare_fn(items[child], items[child + 1]) < 0) child++;
            if (compare_fn(item, items[child]) >= 0) break;
            items[root] = items[child];
            root = child;
        }
        items[root] = item;
    }
}

/* Of two places where a name is pointed to: keys, or tensors, which begin with theirs. */
static int disti_compare_name(const void *a, const void *b)
{
    return strcmp(*(const char *const *)a, *(const char *const *)b);
}

static int disti_compare_data(const void *a, const void *b)
{
    const disti_tensor *x = (const disti_tensor *)a, *y = (const disti_tensor *)b;
    if (x->data != y->data) return x->data < y->data ? -1 : 1;
    return x->bytes < y->bytes ? -1 : x->bytes > y->bytes;
}

/* Sorts by name; 0 if one stands twice. */
static int disti_archive_unique(disti_reader *r, const char *kind, size_t n, const void **order)
{
    disti_sort(n, order, disti_compare_name);
    for (size_t i = 1; i < n; i++) {
        if (disti_compare_name(order[i - 1], order[i]) != 0) continue;
        const char *name = *(const char *const *)order[i];
        disti_archive_about(r, kind, name, strlen(name));
        return disti_bad(r, "stands in the header twice", NULL, 0, 0);
    }
    return 1;
}

/* What no single entry shows: names that stand twice, overlaps, holes. Leaves the order by name. */
static int disti_archive_check(disti_reader *r)
{
    disti_archive *archive = r->archive;
    const void **order = archive->order;
    for (size_t i = 0; i < archive->meta_count; i++) order[i] = &archive->keys[i];
    if (!disti_archive_unique(r, "metadata key", archive->meta_count, order)) return 0;
    for (size_t i = 0; i < archive->tensor_count; i++) order[i] = &archive->tensors[i];
    disti_sort(archive->tensor_count, order, disti_compare_data);
    const unsigned char *next = r->end;
    for (size_t i = 0; i < archive->tensor_count; i++) {
        const disti_tensor *tensor = (const disti_tensor *)order[i];
        disti_archive_about(r, "tensor", tensor->name, strlen(tensor->name));
        if (tensor->data != next)
            return disti_bad(r, "leaves %s: its data_offsets begin at %d, must begin at %d",
                             tensor->data < next ? "an overlap" : "a hole", (double)(tensor->data - r->end),
                             (double)(next - r->end));
        next += tensor->bytes;
    }
    disti_archive_about(r, "the file", NULL, 0);
    if (next != r->end + r->data_size)
        return disti_bad(r, "has %d bytes of data, must have %d for its tensors", NULL, (double)r->data_size,
                         (double)(next - r->end));
    return disti_archive_unique(r, "tensor", archive->tensor_count, order);
}

/* The first byte that is not UTF-8 (nor is a code too long, above 10ffff or half a surrogate pair), or the end. */
static const unsigned char *disti_utf8_end(const unsigned char *c, const unsigned char *end)
{
    while (c < end) {
        int more = *c < 0x80 ? 0 : *c < 0xc2 ? -1 : *c < 0xe0 ? 1 : *c < 0xf0 ? 2 : *c < 0xf5 ? 3 : -1;
        if (more < 0 || more >= end - c) return c;
        for (int i = 1; i <= more; i++)
            if ((c[i] & 0xc0) != 0x80) return c;
        if ((*c == 0xe0 && c[1] < 0xa0) || (*c == 0xed && c[1] > 0x9f)) return c;
        if ((*c == 0xf0 && c[1] < 0x90) || (*c == 0xf4 && c[1] > 0x8f)) return c;
        c += more + 1;
    }
    return c;
}

/* Finds header and data. What is not safetensors at all is named, where its first bytes tell. */
static int disti_archive_header(disti_reader *r, size_t size)
{
    static const char others[5][2][37] = {
        {"PK\3\4", "a zip (PyTorch checkpoint, or .npz)"}, {"\x80", "a PyTorch checkpoint (pickle)"},
        {"GGUF", "a GGUF file"}, {"\x93NUMPY", "a numpy file"}, {"\x89HDF", "an HDF5 file"}};
    uint64_t length = 0;
    for (size_t i = 0; i < 8 && i < size; i++) length |= (uint64_t)r->bytes[i] << 8 * i;
    for (int i = 0; i < 5; i++)
        if ((size < 10 || length > DISTI_HEADER_MAX) && size >= strlen(others[i][0]) &&
            memcmp(r->bytes, others[i][0], strlen(others[i][0])) == 0)
            return disti_bad(r, "is %s, must be safetensors: save the state_dict with safetensors", others[i][1], 0, 0);
    if (size < 10) return disti_bad(r, "has %d bytes, a safetensors file has at least 10", NULL, (double)size, 0);
    size_t most = DISTI_MIN(size - 8, (size_t)DISTI_HEADER_MAX);
    if (length < 2 || length > most)
        return disti_bad(r, "has a header length of %d, must be 2 to %d: no safetensors", NULL, (double)length,
                         (double)most);
    r->header = r->bytes + 8;
    r->end = r->header + (size_t)length;
    r->data_size = size - 8 - (size_t)length;
    if (r->header[0] != '{') return disti_bad(r, "has byte %d at 8, must be %d: a '{'", NULL, r->header[0], '{');
    r->cursor = disti_utf8_end(r->header, r->end);
    if (r->cursor == r->end) return 1;
    return disti_bad(r, "has a header that is not UTF-8 at byte %d", NULL, disti_json_at(r), 0);
}

/* Safe on a zeroed archive and on one that failed. */
static void disti_archive_close(dist_context *ctx, disti_archive *archive)
{
    disti_free(ctx, archive->block, archive->block_bytes);
    memset(archive, 0, sizeof *archive);
}

/* bytes (size) are borrowed until disti_archive_close and must not change. Sentences start with `function`.
   The archive needs no closing after a failure. */
static dist_status disti_archive_open(dist_context *ctx, const char *function, const void *bytes, size_t size,
                                      disti_archive *archive)
{
    disti_reader r;
    memset(&r, 0, sizeof r);
    memset(archive, 0, sizeof *archive);
    r.ctx = ctx;
    r.function = function;
    r.kind = "the file";
    r.bytes = (const unsigned char *)bytes;
    r.archive = archive;
    if (!disti_archive_header(&r, size) || !disti_archive_pass(&r)) return DIST_BAD_FILE;
    size_t tensors, pairs, order, total;
    disti_size_mul(archive->tensor_count, sizeof(disti_tensor), &tensors);
    disti_size_mul(archive->meta_count, 2 * sizeof(char *), &pairs);
    disti_size_mul(DISTI_MAX(archive->tensor_count, archive->meta_count), sizeof(void *), &order);
    disti_size_add(tensors, pairs, &total);
    disti_size_add(total, order, &total);
    disti_size_add(total, r.text_size, &total);
    unsigned char *block = (unsigned char *)disti_alloc(ctx, total);
    if (!block) return DIST_OUT_OF_MEMORY;
    archive->block = block;
    archive->block_bytes = total;
    archive->tensors = (disti_tensor *)(void *)block;
    archive->keys = (const char **)(void *)(block + tensors);
    archive->values = archive->keys + archive->meta_count;
    archive->order = (const void **)(void *)(block + tensors + pairs);
    r.text = (char *)block + tensors + pairs + order;
    r.text_bytes = r.text_size;
    if (disti_archive_pass(&r) && disti_archive_check(&r)) return DIST_OK;
    disti_archive_close(ctx, archive);
    return DIST_BAD_FILE;
}

/* NULL if there is none. */
static const disti_tensor *disti_archive_find(const disti_archive *archive, const char *name)
{
    size_t first = 0, count = archive->tensor_count;
    while (count > 0) {
        const disti_tensor *tensor = (const disti_tensor *)archive->order[first + count / 2];
        int side = strcmp(name, tensor->name);
        if (side == 0) return tensor;
        if (side > 0) first += count / 2 + 1;
        count = side > 0 ? count - count / 2 - 1 : count / 2;
    }
    return NULL;
}

static const char *disti_archive_meta(const disti_archive *archive, const char *key)
{
    for (size_t i = 0; i < archive->meta_count; i++)
        if (strcmp(archive->keys[i], key) == 0) return archive->values[i];
    return NULL;
}

/* An IEEE half as the bits of the float of the same value. */
static uint32_t disti_half_bits(uint32_t half)
{
    uint32_t sign = (half & 0x8000u) << 16, exponent = half >> 10 & 31u, fraction = half & 0x3ffu, bits;
    if (exponent == 31) return sign | 0x7f800000u | fraction << 13;
    if (exponent > 0) return sign | (exponent + 112) << 23 | fraction << 13;
    float value = (float)fraction * 5.9604644775390625e-8f; /* 2^-24, the unit of subnormal halves */
    memcpy(&bits, &value, sizeof bits);
    return sign | bits;
}

/* The numbers (count) as floats, bit by bit where they are F32. A tensor of DISTI_DTYPE_OTHER leaves out as it is. */
static void disti_tensor_read(const disti_tensor *tensor, float *out)
{
    const unsigned char *p = tensor->data;
    if (tensor->dtype == DISTI_DTYPE_OTHER) return;
    for (size_t i = 0; i < tensor->count; i++) {
        uint32_t bits = p[0] | (uint32_t)p[1] << 8;
        if (tensor->dtype == DISTI_F32) bits |= (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
        else bits = tensor->dtype == DISTI_F16 ? disti_half_bits(bits) : bits << 16;
        memcpy(out + i, &bits, sizeof bits);
        p += tensor->dtype == DISTI_F32 ? 4 : 2;
    }
}

/* mantissa * 10^exponent as the bits of the nearest double, in whole numbers: no rounding mode, flag or flushing of the
   caller's touches it. sticky: digits that are not zero were cut off behind mantissa. 0 if it is too large. */
static int disti_decimal(uint64_t mantissa, int64_t exponent, int sticky, uint64_t *bits)
{
    uint32_t w[64]; /* little-endian; the value is w * 2^base, with room below to divide in and above to multiply in */
    *bits = 0;
    if (mantissa == 0 || exponent < -400) return 1;
    if (exponent > 310) return 0;
    int left = exponent < 0 ? -(int)exponent : (int)exponent;
    int words = exponent < 0 ? 5 + left * 107 / 1024 : 4; /* log2(10) / 32 < 107 / 1024 */
    int base = -32 * (words - 2);
    memset(w, 0, sizeof w);
    w[words - 2] = (uint32_t)mantissa;
    w[words - 1] = (uint32_t)(mantissa >> 32);
    while (left > 0) {
        uint64_t power = 1, carry = 0;
        for (int i = 0; i < 9 && left > 0; i++, left--) power *= 10;
        for (int i = words - 1; i >= 0 && exponent < 0; i--) {
            carry = carry << 32 | w[i];
            w[i] = (uint32_t)(carry / power);
            carry %= power;
        }
        for (int i = 0; i < words && exponent > 0; i++) {
            carry += w[i] * power;
            w[i] = (uint32_t)carry;
            carry >>= 32;
        }
        if (exponent < 0) sticky |= carry != 0;
        else if (carry) w[words++] = (uint32_t)carry;
    }
    int top = words - 1, shift = 0;
    while (w[top] == 0) top--;
    uint64_t head = (uint64_t)w[top] << 32 | w[top - 1];
    for (; head >> 63 == 0; shift++) head <<= 1;
    head |= shift ? w[top - 2] >> (32 - shift) : 0;
    sticky |= (uint32_t)((uint64_t)w[top - 2] << shift) != 0;
    for (int i = 0; i < top - 2; i++) sticky |= w[i] != 0;
    int binary = 32 * top + 31 - shift + base; /* 2^binary is the first digit of head */
    int kept = binary >= -1022 ? 53 : 53 - (-1022 - binary);
    if (binary > 1023) return 0;
    if (kept < 0) return 1;
    uint64_t whole = kept ? head >> (64 - kept) : 0, rest = head << kept, half = (uint64_t)1 << 63;
    whole += rest > half || (rest == half && (sticky || (whole & 1)));
    *bits = whole + (binary >= -1022 ? (uint64_t)(binary + 1022) << 52 : 0);
    return *bits < 0x7ff0000000000000u;
}

static int disti_digit(const char *c, const char *end)
{
    return c < end && *c >= '0' && *c <= '9';
}

/* [+-]digits[.digits][e[+-]digits] in any locale: 1 and *cursor behind it, or 0 and nothing changed. Rounded to the
   nearest double for up to 19 digits; too small is 0, too large is refused, and so is what is not a number. */
static int disti_parse_double(const char **cursor, const char *end, double *out)
{
    const char *c = *cursor;
    int negative = c < end && *c == '-', point = 0, cut = 0;
    uint64_t mantissa = 0, bits;
    int64_t exponent = 0;
    if (c < end && (*c == '-' || *c == '+')) c++;
    if (!disti_digit(c, end)) return 0;
    for (; disti_digit(c, end) || (!point && c < end && *c == '.' && disti_digit(c + 1, end)); c++) {
        if (*c == '.') {
            point = 1;
        } else if (mantissa < 1000000000000000000u) {
            mantissa = mantissa * 10 + (uint64_t)(*c - '0');
            exponent -= point;
        } else {
            cut |= *c != '0';
            exponent += !point;
        }
    }
    if (c < end && (*c == 'e' || *c == 'E')) {
        const char *e = c + 1;
        int64_t power = 0;
        int minus = e < end && *e == '-';
        if (e < end && (*e == '-' || *e == '+')) e++;
        if (disti_digit(e, end)) {
            for (; disti_digit(e, end); e++)
                if (power < 1000000000000000) power = power * 10 + (*e - '0');
            exponent += minus ? -power : power;
            c = e;
        }
    }
    if (!disti_decimal(mantissa, exponent, cut, &bits)) return 0;
    bits |= (uint64_t)negative << 63;
    memcpy(out, &bits, sizeof bits);
    *cursor = c;
    return 1;
}

typedef struct disti_tensor_out {
    const char *name;
    int rank;
    size_t shape[4];
    const float *data;
} disti_tensor_out;

/* In quotes, escaped. */
static void disti_put_string(disti_writer *w, const char *text)
{
    disti_put(w, "\"", 1);
    for (; *text; text++) {
        unsigned char c = (unsigned char)*text;
        char escape[6] = {'\\', 'u', '0', '0', 0, 0};
        escape[4] = (char)('0' + (c >> 4));
        escape[5] = "0123456789abcdef"[c & 15];
        if (c < 0x20) disti_put(w, escape, 6);
        if (c == '"' || c == '\\') disti_put(w, "\\", 1);
        if (c >= 0x20) disti_put(w, text, 1);
    }
    disti_put(w, "\"", 1);
}

/* SIZE_MAX if it does not fit. */
static size_t disti_tensor_out_bytes(const disti_tensor_out *tensor)
{
    size_t bytes = sizeof(float);
    for (int i = 0; i < tensor->rank; i++)
        if (!disti_size_mul(bytes, tensor->shape[i], &bytes)) return (size_t)-1;
    return bytes;
}

/* Returns the size of the data. */
static size_t disti_put_header(disti_writer *w, size_t tensor_count, const disti_tensor_out *tensors, size_t meta_count,
                               const char *const *keys, const char *const *values)
{
    size_t offset = 0;
    disti_put_text(w, meta_count ? "{\"__metadata__\":{" : "{");
    for (size_t i = 0; i < meta_count; i++) {
        if (i) disti_put_text(w, ",");
        disti_put_string(w, keys[i]);
        disti_put_text(w, ":");
        disti_put_string(w, values[i]);
    }
    if (meta_count) disti_put_text(w, "}");
    for (size_t i = 0; i < tensor_count; i++) {
        if (i || meta_count) disti_put_text(w, ",");
        disti_put_string(w, tensors[i].name);
        disti_put_text(w, ":{\"dtype\":\"F32\",\"shape\":[");
        for (int k = 0; k < tensors[i].rank; k++) {
            if (k) disti_put_text(w, ",");
            disti_put_size(w, tensors[i].shape[k]);
        }
        disti_put_text(w, "],\"data_offsets\":[");
        disti_put_size(w, offset);
        disti_size_add(offset, disti_tensor_out_bytes(&tensors[i]), &offset);
        disti_put_text(w, ",");
        disti_put_size(w, offset);
        disti_put_text(w, "]}");
    }
    disti_put_text(w, "}");
    return offset;
}

/* Writes metadata and tensors in the order given, all F32; the same input gives the same bytes. Names and keys are
   UTF-8 and none stands twice. *size is always set, to 0 where nothing can be written; with buffer NULL that is all. */
static dist_status disti_archive_write(dist_context *ctx, const char *function, size_t tensor_count,
                                       const disti_tensor_out *tensors, size_t meta_count, const char *const *keys,
                                       const char *const *values, void *buffer, size_t capacity, size_t *size)
{
    disti_writer w = {NULL, 8};
    *size = 0;
    size_t data = disti_put_header(&w, tensor_count, tensors, meta_count, keys, values), total;
    if (w.size > DISTI_HEADER_MAX)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: names and metadata have %d bytes, must be at most %d", function,
                          (double)w.size, DISTI_HEADER_MAX);
    size_t begin = (w.size + 7) / 8 * 8; /* so that a reader may map the floats where they lie */
    if (!disti_size_add(begin, data, &total) || total == (size_t)-1)
        return disti_fail(ctx, DIST_OUT_OF_MEMORY, "%s: the tensors' size does not fit size_t", function, 0, 0);
    *size = total;
    if (!buffer) return DIST_OK;
    if (capacity < total) return disti_capacity(ctx, function, capacity, total);
    w.out = (unsigned char *)buffer;
    w.size = 8;
    for (size_t i = 0; i < 8; i++) w.out[i] = (unsigned char)((uint64_t)(begin - 8) >> 8 * i);
    disti_put_header(&w, tensor_count, tensors, meta_count, keys, values);
    while (w.size < begin) disti_put(&w, " ", 1);
    for (size_t i = 0; i < tensor_count; i++) {
        size_t count = disti_tensor_out_bytes(&tensors[i]) / sizeof(float);
        for (size_t k = 0; k < count; k++) disti_put_float(&w, tensors[i].data[k]);
    }
    return DIST_OK;
}

enum { DISTI_MAX_LAYERS = 32, DISTI_MAX_WIDTH = 8192, DISTI_MAX_LEVELS = 16, DISTI_MAX_CHANNELS = 16 };
enum { DISTI_OUTPUT_TANH, DISTI_OUTPUT_NONE, DISTI_OUTPUT_SIGMOID, DISTI_OUTPUT_TANH_TWICE };
enum { DISTI_ORDER_SIN_COS, DISTI_ORDER_COS_ALL, DISTI_ORDER_SIN_ALL };

/* One linear layer. Its rows, as the kernels see them, are the previous layer's units (`prev`), then, in layer 0 and in
   skip layers, the encoded point (`point`); the code's columns are folded into the bias. */
typedef struct disti_linear {
    int in, out;      /* as in the file */
    int prev, point;  /* rows = prev + point */
    int code;         /* columns of the code: code_size or 0 */
    int x_column, point_column, code_column; /* where they start in the file's columns */
    float scale;      /* on all columns: a skip layer's skip_scale, else 1 */
    size_t weight, bias, norm_weight, norm_bias; /* offsets into params */
    size_t panel;     /* offset into panels; the last layer's is plain (out, rows) */
    size_t half_panel; /* likewise into half_panels; hidden layers' previous units only */
} disti_linear;

struct dist_net {
    dist_allocator allocator;
    int layers; /* linear layers, the last included */
    int code_size, code_count;
    int channels, sdf_channel, color_channel; /* -1: none; color_channel: the first of r, g, b */
    int activation, output, normed;
    float first_scale, scale;
    int point_first;      /* input is [point, code], not [code, point] */
    int skip_input_first; /* skip layers see [input, x], not [x, input] */
    int levels, raw, order, point_size;
    double base;
    float norm_epsilon, level, bound, clamp;
    int max_rows; /* largest rows or out of a layer, rounded up to 8 */
    int fold_count; /* layers that see the code */
    disti_linear layer[DISTI_MAX_LAYERS];
    float *params, *panels, *codes;
    int *unit_order; /* (2, layers, max_rows): the file's units as they stand in the kernels, and each one's place
                        there; NULL: as in the file */
    float *half_panels; /* 32 bits each: two 16-bit weights; NULL: none */
    int half;           /* DIST_HALF_F16 or BF16, or 0 */
    unsigned changes;   /* disti_hash of the weights */
    size_t param_count, panel_count, half_count;
    char channel_names[DISTI_MAX_CHANNELS][8];
};

struct dist_shape {
    dist_context *ctx;
    const dist_net *net;
    disti_kernels kernels; /* of the context's instructions */
    float *code;
    float *bias; /* (layers + 1, max_rows): each layer's bias with the code folded in; then zeros, for tangents */
    float lipschitz, lipschitz_far, certified, certified_far, noise;
    float half_error; /* largest of 16 bits at the samples of disti_shape_slope */
    int half;         /* what the net had then */
    unsigned changes; /* disti_hash of the code */
    unsigned folded;  /* its net's changes when the code was folded in */
    unsigned textures; /* that it got, so far */
    int groups;       /* disti_groups_pay */
    int wide;         /* its net's queries cost enough for one more look at a batch's points to pay */
    int many;         /* dist_field.many: two thirds or less of a block's multiply-adds are left with bounds */
    uint32_t all_alive; /* bit l: the samples of disti_shape_slope met no dead unit at layer l's input */
    dist_shape *texture; /* the net that colors it, with [code, color code] folded in; NULL: none */
    size_t store_block_size; /* of activations and deltas, for weight gradients; ctx->store holds store_blocks */
    int store_blocks;
};

/* Memory of one block on its way through the net, laid out in the worker's scratch. */
typedef struct disti_block {
    float *point;      /* (point_size, B): the encoded point */
    float *d_point;    /* its gradient */
    float *act[2];     /* (max_rows, B): a layer's input */
    float *delta[2];   /* (max_rows, B): dL/d(pre-activation) */
    float *fold_delta; /* (fold_count, max_rows, B): that of the layers that see the code, alive rows */
    uint64_t *mask;    /* (layers, max_rows): which lanes of a layer's input rows are alive */
    int *alive;        /* (layers, max_rows): rows of a layer's input that are alive anywhere in the block */
    float *slope;      /* (layers, max_rows, B): activation's derivative; not for ReLU */
    float *hat;        /* (layers, max_rows, B): LayerNorm's normalized values */
    float *inverse;    /* (layers, B): and its 1 / sigma */
    float *fold_lanes; /* (fold_count, max_rows, 16): parts of the sums of fold_delta over points, of few blocks */
    double *fold_sum;  /* (fold_count, max_rows): the sums */
    float *value, *value_slope, *value_curvature; /* (B): of an output channel */
    float *seed;       /* (3, B): its gradient, or those of r, g, b */
    float *pull;       /* (B, 3): what the seed gives the points */
    int alive_count[DISTI_MAX_LAYERS];
    int alive_units[DISTI_MAX_LAYERS]; /* of them, units: those before the encoded point's rows */
    int columns;
    int values; /* no reverse pass follows: masks and slopes need not be kept */
    int channel, channels; /* the output's channels that the reverse pass starts from: the distance, or r, g, b */
    int half; /* 0; or B / 2: lane c + half is the tangent of lane c, see disti_second_block */
    int tangents; /* 0; or n: lanes n + 3 c to n + 3 c + 2 are those of lane c < n, see disti_few_gradient */
} disti_block;

/* Returns the bytes needed; base NULL: only that. Sizes are bounded by 32 layers of 8192 + 99 rows. */
static size_t disti_block_layout(const dist_net *net, unsigned char *base, disti_block *b)
{
    size_t at = 0, rows = (size_t)net->max_rows, layers = (size_t)net->layers, row = DISTI_BLOCK * sizeof(float);
    size_t point = disti_round_up((size_t)net->point_size, 8);
    memset(b, 0, sizeof *b);
    b->point = (float *)disti_take(base, &at, point, row);
    b->d_point = (float *)disti_take(base, &at, point, row);
    for (int i = 0; i < 2; i++) {
        b->act[i] = (float *)disti_take(base, &at, rows, row);
        b->delta[i] = (float *)disti_take(base, &at, rows, row);
    }
    b->fold_delta = (float *)disti_take(base, &at, (size_t)net->fold_count * rows, row);
    b->mask = (uint64_t *)disti_take(base, &at, layers * rows, sizeof(uint64_t));
    b->alive = (int *)disti_take(base, &at, layers * rows, sizeof(int));
    if (net->activation != DIST_ACTIVATION_RELU) b->slope = (float *)disti_take(base, &at, layers * rows, row);
    if (net->normed) {
        b->hat = (float *)disti_take(base, &at, layers * rows, row);
        b->inverse = (float *)disti_take(base, &at, layers, row);
    }
    b->fold_lanes = (float *)disti_take(base, &at, (size_t)net->fold_count * rows, 16 * sizeof(float));
    b->fold_sum = (double *)disti_take(base, &at, (size_t)net->fold_count * rows, sizeof(double));
    b->value = (float *)disti_take(base, &at, 1, row);
    b->value_slope = (float *)disti_take(base, &at, 1, row);
    b->value_curvature = (float *)disti_take(base, &at, 1, row);
    b->seed = (float *)disti_take(base, &at, 3, row);
    b->pull = (float *)disti_take(base, &at, 3, row);
    return at;
}

/* What weight gradients need of each layer, one block's share of the store: the input transposed (B, stride) and
   scaled, the pre-activation's delta (out8, B), and the sums for LayerNorm's gamma and beta (out8 each). */
static size_t disti_store_stride(const disti_linear *layer)
{
    return disti_round_up((size_t)(layer->prev + layer->point), 16);
}

static size_t disti_store_out(const disti_linear *layer)
{
    return disti_round_up((size_t)layer->out, 16);
}

enum { DISTI_STORE_INPUT, DISTI_STORE_DELTA, DISTI_STORE_NORM };

/* Offset of one of the three for layer l; l = layers: the size of the whole. */
static size_t disti_store_offset(const dist_net *net, int l, int part)
{
    size_t at = 0;
    for (int i = 0; i < l; i++)
        at += disti_store_stride(&net->layer[i]) * DISTI_BLOCK + disti_store_out(&net->layer[i]) * (DISTI_BLOCK + 2);
    if (part >= DISTI_STORE_DELTA) at += disti_store_stride(&net->layer[l]) * DISTI_BLOCK;
    if (part >= DISTI_STORE_NORM) at += disti_store_out(&net->layer[l]) * DISTI_BLOCK;
    return at;
}

/* forward   raw: p;  level k: sin(b 2^k p), cos(b 2^k p)    in double by doubling the angle: sin 2a = 2 sin a cos a,
             cos 2a = 1 - 2 sin^2 a, so that float rounding of large angles does not enter
   The row of (level, axis, sine or cosine) depends on the order. */
static int disti_encoding_row(const dist_net *net, int level, int axis, int cosine)
{
    int first = net->raw ? 3 : 0, half = 3 * net->levels;
    if (net->order == DISTI_ORDER_SIN_COS) return first + 6 * level + (cosine ? 3 : 0) + axis;
    int second = net->order == DISTI_ORDER_COS_ALL ? !cosine : cosine;
    return first + (second ? half : 0) + 3 * level + axis;
}

static void disti_encode(const dist_net *net, const disti_kernels *kernels, size_t n, const float *points, float *rows)
{
    /* idle lanes repeat the last point: no unit lives for them alone */
    float last[3 * DISTI_BLOCK];
    for (size_t c = 0; c < DISTI_BLOCK && n < DISTI_BLOCK; c++)
        memcpy(last + 3 * c, points + 3 * (c < n ? c : n - 1), 3 * sizeof(float));
    if (n < DISTI_BLOCK) points = last;
    float own[3 * DISTI_BLOCK], *x = net->raw ? rows : own;
    kernels->rows(points, x);
    size_t stride = (size_t)(net->order == DISTI_ORDER_SIN_COS ? 6 : 3) * DISTI_BLOCK;
    for (int axis = 0; axis < 3 && net->levels > 0; axis++)
        kernels->angles(net->base, net->levels, x + axis * DISTI_BLOCK, stride,
                        rows + (size_t)disti_encoding_row(net, 0, axis, 0) * DISTI_BLOCK,
                        rows + (size_t)disti_encoding_row(net, 0, axis, 1) * DISTI_BLOCK);
}

/* The tangent along u of the point encoded in rows (., B), `to` lanes on. */
static void disti_encode_tangent(const dist_net *net, const float *u, float *rows, size_t to)
{
    for (int axis = 0; axis < 3; axis++) {
        float factor = (float)net->base * u[axis];
        if (net->raw) rows[(size_t)axis * DISTI_BLOCK + to] = u[axis];
        for (int k = 0; k < net->levels; k++) {
            size_t s = (size_t)disti_encoding_row(net, k, axis, 0) * DISTI_BLOCK;
            size_t co = (size_t)disti_encoding_row(net, k, axis, 1) * DISTI_BLOCK;
            rows[s + to] = factor * rows[co];
            rows[co + to] = -factor * rows[s];
            factor *= 2.0f;
        }
    }
}

/* backward  d_p = d_raw + sum_k b 2^k (cos(b 2^k p) d_sin_k - sin(b 2^k p) d_cos_k)
   The tangents' rows sin' = b 2^k cos u, cos' = -b 2^k sin u have the same adjoint in terms of themselves. */
static void disti_encode_backward(const dist_shape *shape, const disti_block *b)
{
    const dist_net *net = shape->net;
    const float *rows = b->point, *d_rows = b->d_point;
    float *d_points = b->pull;
    size_t half = (size_t)b->half;
    if (net->raw && net->levels == 0) {
        shape->kernels.points(d_rows, d_points);
        return;
    }
    for (size_t c = 0; c < (half ? half : (size_t)DISTI_BLOCK); c++) {
        for (int axis = 0; axis < 3; axis++) {
            float sum = net->raw ? d_rows[(size_t)axis * DISTI_BLOCK + c] : 0.0f;
            float factor = (float)net->base;
            for (int k = 0; k < net->levels; k++) {
                size_t s = (size_t)disti_encoding_row(net, k, axis, 0) * DISTI_BLOCK + c;
                size_t co = (size_t)disti_encoding_row(net, k, axis, 1) * DISTI_BLOCK + c;
                sum += factor * (rows[co] * d_rows[s] - rows[s] * d_rows[co]);
                if (half) sum += factor * (rows[co + half] * d_rows[s + half] - rows[s + half] * d_rows[co + half]);
                factor *= 2.0f;
            }
            d_points[3 * c + (size_t)axis] = sum;
        }
    }
}

/* Whether no row of layer l's input is looked at for being dead: where none can be, or where only values are wanted and
   the shape's samples met none. */
static int disti_all_alive(const dist_shape *shape, const disti_block *b, int l)
{
    return shape->net->activation != DIST_ACTIVATION_RELU || (b->values && (shape->all_alive >> l & 1));
}

/* Lists the alive rows of layer l's input; the encoded point's rows always are. */
static void disti_list_alive(const dist_shape *shape, disti_block *b, int l)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    uint64_t *mask = b->mask + (size_t)l * (size_t)net->max_rows;
    int *alive = b->alive + (size_t)l * (size_t)net->max_rows;
    int count = 0, u = 0;
    b->alive_units[l] = layer->prev;
    b->alive_count[l] = layer->prev + layer->point;
    if (disti_all_alive(shape, b, l)) return; /* no list: nobody reads one that leaves nothing out */
    for (int i = 0; i < layer->point; i++) mask[layer->prev + i] = ~(uint64_t)0;
    for (; u + 4 <= layer->prev; u += 4) /* bit 63 of m - 1 says that no lane's bit is set in m */
        if (((mask[u] - 1) | (mask[u + 1] - 1) | (mask[u + 2] - 1) | (mask[u + 3] - 1)) >> 63) break;
    while (u < layer->prev && mask[u]) u++;
    if (u == layer->prev) return;
    for (; count < u; count++) alive[count] = count;
    for (; u < layer->prev; u++) {
        alive[count] = u;
        count += mask[u] != 0;
    }
    b->alive_units[l] = count;
    for (int i = 0; i < layer->point; i++) alive[count++] = layer->prev + i;
    b->alive_count[l] = count;
}

/* A linear layer by the user's BLAS, rows of `stride`: the previous units' columns, then the point's. The product is
   added to the bias, since a BLAS clears y in a pass of its own where it is not to add. */
static void disti_linear_blas(const dist_shape *shape, int l, const float *bias, int columns, int stride,
                              const float *x, const float *point, float *y)
{
    const disti_linear *layer = &shape->net->layer[l];
    const dist_blas *blas = &shape->ctx->blas;
    const float *w = shape->net->params + layer->weight;
    for (size_t o = 0; o < (size_t)layer->out; o++)
        for (size_t c = 0; c < (size_t)columns; c++) y[o * (size_t)stride + c] = bias[o];
    blas->sgemm_fn(blas->user, 0, 0, layer->out, columns, layer->prev, layer->scale, w + layer->x_column, layer->in, x,
                   stride, 1.0f, y, stride);
    if (layer->point > 0)
        blas->sgemm_fn(blas->user, 0, 0, layer->out, columns, layer->point, layer->scale, w + layer->point_column,
                       layer->in, point, stride, 1.0f, y, stride);
}

static int disti_use_blas(const dist_shape *shape, int l)
{
    const disti_linear *layer = &shape->net->layer[l];
    int width = shape->ctx->blas_width;
    return shape->ctx->blas.sgemm_fn && !shape->net->unit_order && layer->out >= width && layer->prev >= width;
}

static int disti_net_narrowest(const dist_net *net)
{
    int narrow = net->max_rows;
    for (int l = 0; l + 1 < net->layers; l++) narrow = DISTI_MIN(narrow, net->layer[l].out);
    return narrow;
}

/* Whether nothing but ReLU stands between the net's layers. */
static int disti_net_plain(const dist_net *net) { return net->activation == DIST_ACTIVATION_RELU && !net->normed; }

/* Wide nets of units that can be dead and of inputs that are the point itself. */
static int disti_net_sparse(const dist_net *net)
{
    return disti_net_plain(net) && net->levels == 0 && net->layers > 2 && net->max_rows <= 1100 &&
           disti_net_narrowest(net) >= 96;
}

/* The file's number of unit u of layer l; the last layer's stand as in the file. */
static size_t disti_unit(const dist_net *net, int l, size_t u)
{
    return net->unit_order ? (size_t)net->unit_order[(size_t)l * (size_t)net->max_rows + u] : u;
}

/* Where the file's input k of layer l stands in the kernels. */
static size_t disti_place_of(const dist_net *net, int l, size_t k)
{
    if (!net->unit_order || k >= (size_t)net->layer[l].prev) return k;
    return (size_t)net->unit_order[(size_t)(net->layers + l - 1) * (size_t)net->max_rows + k];
}

/* Layer l's input x to (B, stride), the file's units side by side. A cache line of each column is filled at a time. */
static void disti_transpose(const dist_shape *shape, int l, const float *x, float *xt)
{
    const dist_net *net = shape->net;
    enum { LINE = 16 };
    const disti_linear *layer = &net->layer[l];
    size_t stride = disti_store_stride(layer), rows = (size_t)(layer->prev + layer->point);
    for (size_t first = 0; first < rows; first += LINE) {
        const float *from[LINE];
        size_t count = DISTI_MIN(rows - first, (size_t)LINE);
        for (size_t k = 0; k < count; k++) from[k] = x + disti_place_of(net, l, first + k) * DISTI_BLOCK;
        if (count == LINE) shape->kernels.transpose(from, layer->scale, xt + first, stride);
        for (size_t c = 0; c < DISTI_BLOCK && count < LINE; c++)
            for (size_t k = 0; k < count; k++) xt[c * stride + first + k] = layer->scale * from[k][c];
    }
}

/* The rest of hidden layer l where lanes are values and tangents: W x in y becomes phi(norm(W x + b)) and, along the
   direction, its derivative phi'(a) a'. slope keeps phi'(a) and, in the tangent's lane, phi''(a) a'. */
static void disti_hidden_tangents(const dist_shape *shape, const disti_block *b, int l, float *y)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t width = (size_t)net->max_rows, out = (size_t)layer->out, at = (size_t)l * width;
    const float *bias = shape->bias + at;
    for (size_t u = 0; u < out; u++) {
        const float add = bias[u];
        for (size_t c = 0; c < DISTI_BLOCK / 2; c++) y[u * DISTI_BLOCK + c] += add;
    }
    if (net->normed)
        shape->kernels.norm_tangents(layer->out, net->norm_epsilon, net->params + layer->norm_weight,
                                     net->params + layer->norm_bias, y, b->hat + at * DISTI_BLOCK,
                                     b->inverse + (size_t)l * DISTI_BLOCK);
    shape->kernels.activate_tangents(net->activation, l == 0 ? net->first_scale : net->scale, out, y,
                                     b->slope ? b->slope + at * DISTI_BLOCK : NULL, b->mask + at + width);
}

/* Hidden layer l: x to the input of layer l + 1 in y, with everything that its adjoint reads. */
static void disti_hidden(const dist_shape *shape, disti_block *b, int l, const float *x, float *y)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t width = (size_t)net->max_rows, out = (size_t)layer->out;
    uint64_t *mask = b->mask + (size_t)(l + 1) * width;
    const float *bias = shape->bias + (size_t)(b->half ? net->layers : l) * width;
    int plain = disti_net_plain(net) && !b->half;
    if (disti_use_blas(shape, l)) {
        disti_linear_blas(shape, l, bias, DISTI_BLOCK, DISTI_BLOCK, x, x + (size_t)layer->prev * DISTI_BLOCK, y);
        if (plain) shape->kernels.relu(out, y, mask);
    } else {
        int rows = layer->prev + layer->point, alive_count = b->alive_count[l];
        const int *alive = alive_count < rows ? b->alive + (size_t)l * width : NULL;
        uint64_t *asked = plain && !disti_all_alive(shape, b, l + 1) ? mask : NULL;
        disti_gemm g = {net->panels + layer->panel, bias, x, y, alive, asked, rows, alive_count, layer->out,
                        b->columns, plain};
        shape->kernels.gemm(&g);
    }
    if (net->normed && !b->half)
        shape->kernels.norm(layer->out, net->norm_epsilon, net->params + layer->norm_weight,
                            net->params + layer->norm_bias, y, b->hat + (size_t)l * width * DISTI_BLOCK,
                            b->inverse + (size_t)l * DISTI_BLOCK);
    if (b->half) {
        disti_hidden_tangents(shape, b, l, y);
    } else if (net->activation != DIST_ACTIVATION_RELU) {
        float *slope = b->values ? NULL : b->slope + (size_t)l * width * DISTI_BLOCK;
        float scale = l == 0 ? net->first_scale : net->scale;
        size_t n = out, lanes = disti_round_up((size_t)b->columns, 16); /* idle ones are nobody's */
        if (lanes == DISTI_BLOCK) { /* at once */
            lanes *= n;
            n = 1;
        }
        for (size_t i = 0; i < n * DISTI_BLOCK; i += DISTI_BLOCK)
            shape->kernels.activate(net->activation, scale, lanes, y + i, slope ? slope + i : NULL);
    } else if (!plain) {
        shape->kernels.relu(out, y, mask);
        for (size_t u = 0; b->columns < DISTI_BLOCK && u < out; u++) /* the others hold what was there before */
            mask[u] &= ((uint64_t)1 << b->columns) - 1;
    }
    const disti_linear *next = &net->layer[l + 1];
    if (next->point > 0) memcpy(y + out * DISTI_BLOCK, b->point, (size_t)next->point * DISTI_BLOCK * sizeof(float));
    disti_list_alive(shape, b, l + 1);
}

/* All hidden layers of the block whose encoded points stand in b->point. Returns the last layer's input.
   store, unless NULL, gets every layer's input transposed. */
static const float *disti_net_forward(const dist_shape *shape, disti_block *b, float *store, disti_counter *counter)
{
    const dist_net *net = shape->net;
    const float *x = b->point;
    double done = 0.0;
    disti_list_alive(shape, b, 0);
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        if (store)
            disti_transpose(shape, l, x, store + disti_store_offset(net, l, DISTI_STORE_INPUT));
        done += (double)b->alive_count[l] * layer->out;
        if (l + 1 == net->layers) break;
        disti_hidden(shape, b, l, x, b->act[l & 1]);
        x = b->act[l & 1];
    }
    counter->done += done * b->columns;
    return x;
}

/* v less the level to value, but where value, the layer's sum, is not finite: that is what the ray is told. There the
   slope d, unless NULL, and the curvature are 0. */
DISTI_LOOPS static void disti_output_end(size_t count, float level, const float *DISTI_RESTRICT v,
                                         float *DISTI_RESTRICT value, float *DISTI_RESTRICT d,
                                         float *DISTI_RESTRICT bend)
{
    for (size_t c = 0; d && c < count; c++) {
        const float slope = d[c], curvature = bend[c];
        d[c] = disti_finite(value[c]) ? slope : 0.0f;
        bend[c] = disti_finite(value[c]) ? curvature : 0.0f;
    }
    for (size_t c = 0; c < count; c++) {
        const float moved = v[c] - level;
        value[c] = disti_finite(value[c]) ? moved : value[c];
    }
}

/* Channel `channel` of the last layer to b->value after the output function, its slope and its curvature. Tangents'
   lanes of the value get the layer's tangent without the function's slope. */
static void disti_net_output(const dist_shape *shape, const disti_block *b, const float *x, int channel)
{
    const dist_net *net = shape->net;
    float *value = b->value;
    int l = net->layers - 1;
    const disti_linear *layer = &net->layer[l];
    int rows = layer->prev + layer->point;
    const int *alive = b->alive_count[l] < rows ? b->alive + (size_t)l * (size_t)net->max_rows : NULL;
    float bias = shape->bias[(size_t)l * (size_t)net->max_rows + (size_t)channel];
    const float *w = net->panels + layer->panel + (size_t)channel * (size_t)rows;
    shape->kernels.dot(w, b->half ? 0.0f : bias, x, alive, b->alive_count[l], rows, b->columns, value);
    float v[DISTI_BLOCK], t[DISTI_BLOCK], *d = b->value_slope, *bend = b->value_curvature;
    int twice = net->output == DISTI_OUTPUT_TANH_TWICE;
    size_t count = b->half ? (size_t)b->half : (size_t)DISTI_BLOCK;
    memcpy(v, value, sizeof v);
    for (size_t c = 0; c < DISTI_BLOCK && b->half; c++) v[c] += bias;
    for (size_t c = 0; c < DISTI_BLOCK && !b->values; c++) d[c] = 1.0f, bend[c] = 0.0f;
    for (int k = 0; k < twice + (twice || net->output == DISTI_OUTPUT_TANH); k++) {
        shape->kernels.activate(DIST_ACTIVATION_TANH, 1.0f, DISTI_BLOCK, v, b->values ? NULL : t);
        for (size_t c = 0; c < count && b->half; c++)
            bend[c] = t[c] * (bend[c] - 2.0f * v[c] * d[c] * d[c]); /* of t(v): t'' v'^2 + t' v'' */
        for (size_t c = 0; c < DISTI_BLOCK && !b->values; c++) d[c] *= t[c];
    }
    for (size_t c = 0; c < count && net->output == DISTI_OUTPUT_SIGMOID; c++) {
        float slope = disti_sigmoid_slope(v[c]);
        v[c] = disti_sigmoid(v[c]);
        if (!b->values) d[c] = slope, bend[c] = slope * (1.0f - 2.0f * v[c]);
    }
    disti_output_end(count, channel == net->sdf_channel ? net->level : 0.0f, v, value, b->values ? NULL : d, bend);
}

/* delta of layer l's output (after the activation) to that of its pre-activation, in place. ReLU's mask is in it
   already. sums is NULL where no weights are asked for; LayerNorm leaves what gamma and beta receive there: sum_c delta
   hat, sum_c delta. Rows of dead units, which were not written, become 0 where they are read. */
static void disti_hidden_delta(const dist_shape *shape, const disti_block *b, int l, float *delta, float *sums)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t width = (size_t)net->max_rows, out = (size_t)layer->out;
    const uint64_t *mask = b->mask + (size_t)(l + 1) * width;
    if (b->slope) shape->kernels.activate_back(out, (size_t)b->half, b->slope + (size_t)l * width * DISTI_BLOCK, delta);
    if (net->activation == DIST_ACTIVATION_RELU && (sums || net->normed || disti_use_blas(shape, l)))
        for (size_t u = 0; u < out; u++)
            if (!mask[u]) memset(delta + u * DISTI_BLOCK, 0, DISTI_BLOCK * sizeof(float));
    if (!net->normed) return;
    const float *hat = b->hat + (size_t)l * width * DISTI_BLOCK;
    for (size_t u = 0; sums && u < out; u++) {
        sums[u] = sums[disti_store_out(layer) + u] = 0.0f;
        for (size_t c = 0; c < (size_t)b->columns; c++) {
            sums[u] += delta[u * DISTI_BLOCK + c] * hat[u * DISTI_BLOCK + c];
            if (!b->half || c < (size_t)b->half) sums[disti_store_out(layer) + u] += delta[u * DISTI_BLOCK + c];
        }
    }
    shape->kernels.norm_back(layer->out, net->params + layer->norm_weight, (size_t)b->half, hat,
                             b->inverse + (size_t)l * DISTI_BLOCK, delta);
}

/* delta of layer l's pre-activation to its input rows d_x: W^T delta, masked. */
static void disti_linear_backward(const dist_shape *shape, const disti_block *b, int l, const float *delta, float *d_x)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t width = (size_t)net->max_rows;
    int relu = net->activation == DIST_ACTIVATION_RELU;
    const uint64_t *mask = relu ? b->mask + (size_t)l * width : NULL;
    int rows = layer->prev + layer->point;
    if (disti_use_blas(shape, l)) {
        const dist_blas *blas = &shape->ctx->blas;
        const float *w = net->params + layer->weight;
        blas->sgemm_fn(blas->user, 1, 0, layer->prev, DISTI_BLOCK, layer->out, layer->scale, w + layer->x_column,
                       layer->in, delta, DISTI_BLOCK, 0.0f, d_x, DISTI_BLOCK);
        if (layer->point > 0)
            blas->sgemm_fn(blas->user, 1, 0, layer->point, DISTI_BLOCK, layer->out, layer->scale,
                           w + layer->point_column, layer->in, delta, DISTI_BLOCK, 0.0f,
                           d_x + (size_t)layer->prev * DISTI_BLOCK, DISTI_BLOCK);
        for (size_t u = 0; mask && u < (size_t)rows; u++)
            for (size_t c = 0; c < DISTI_BLOCK; c++)
                if (!(mask[u] >> c & 1u)) d_x[u * DISTI_BLOCK + c] = 0.0f;
        return;
    }
    int sparse = relu && !net->normed && b->alive_units[l + 1] < layer->out;
    const int *alive_out = sparse ? b->alive + (size_t)(l + 1) * width : NULL;
    const int *alive_rows = b->alive_count[l] < rows ? b->alive + (size_t)l * width : NULL;
    disti_gemm_back g = {net->panels + layer->panel, delta, d_x, alive_out, alive_rows, mask, rows, layer->out,
                         b->alive_units[l + 1], b->alive_count[l], b->columns};
    shape->kernels.gemm_back(&g);
}

static void disti_add_point_rows(const disti_linear *layer, const float *DISTI_RESTRICT d_x,
                                 float *DISTI_RESTRICT d_point)
{
    const float *from = d_x + (size_t)layer->prev * DISTI_BLOCK;
    for (int row = 0; row < layer->point; row++, from += DISTI_BLOCK, d_point += DISTI_BLOCK)
        for (size_t c = 0; c < DISTI_BLOCK; c++) d_point[c] += from[c]; /* of a known length: in vectors */
}

/* delta of the last layer's input: sum over the channels of W_k^T seed_k, masked. */
static void disti_output_backward(const dist_shape *shape, const disti_block *b, const float *seed, float *delta)
{
    const dist_net *net = shape->net;
    int last = net->layers - 1, rows = net->layer[last].prev + net->layer[last].point, count = b->alive_count[last];
    size_t at = (size_t)last * (size_t)net->max_rows;
    const int *alive = count < rows ? b->alive + at : NULL;
    const uint64_t *mask = net->activation == DIST_ACTIVATION_RELU ? b->mask + at : NULL;
    const float *w = net->panels + net->layer[last].panel + (size_t)b->channel * (size_t)rows;
    shape->kernels.outer(w, seed, alive, count, rows, b->columns, mask, delta);
    for (int k = 1; k < b->channels; k++) {
        float *more = b->delta[(last + 1) & 1];
        shape->kernels.outer(w + k * rows, seed + k * DISTI_BLOCK, alive, count, rows, b->columns, mask, more);
        for (int i = 0; i < count; i++) {
            size_t row = (size_t)(alive ? alive[i] : i) * DISTI_BLOCK;
            for (size_t c = 0; c < (size_t)b->columns; c++) delta[row + c] += more[row + c];
        }
    }
}

/* Where layer l's delta goes: what the code's gradient needs is kept. fold: how many layers up to l see the code. */
static float *disti_delta_room(const dist_net *net, const disti_block *b, int l, int *fold)
{
    if (l < 0 || !net->layer[l].code) return b->delta[(l + 1) & 1];
    return b->fold_delta + (size_t)--*fold * (size_t)net->max_rows * DISTI_BLOCK;
}

/* Reverse pass of one block from the seeds (channels, B) at the last layer's pre-activation: leaves the points'
   gradient in b->pull and the deltas of the layers that see the code in b->fold_delta; store, unless NULL, gets all
   deltas. */
static void disti_net_reverse(const dist_shape *shape, disti_block *b, const float *seed, float *store)
{
    const dist_net *net = shape->net;
    int last = net->layers - 1, fold = net->fold_count;
    size_t seeds = (size_t)b->channels * DISTI_BLOCK * sizeof(float);
    const disti_linear *layer = &net->layer[last];
    memset(b->d_point, 0, (size_t)net->point_size * DISTI_BLOCK * sizeof(float));
    if (store) memcpy(store + disti_store_offset(net, last, DISTI_STORE_DELTA), seed, seeds);
    if (layer->code) memcpy(disti_delta_room(net, b, last, &fold), seed, seeds);
    float *delta = disti_delta_room(net, b, last - 1, &fold);
    disti_output_backward(shape, b, seed, delta);
    disti_add_point_rows(layer, delta, b->d_point);
    for (int l = last - 1; l >= 0; l--) {
        layer = &net->layer[l];
        disti_hidden_delta(shape, b, l, delta,
                           store ? store + disti_store_offset(net, l, DISTI_STORE_NORM) : NULL);
        float *kept = store ? store + disti_store_offset(net, l, DISTI_STORE_DELTA) : NULL;
        for (size_t u = 0; kept && u < (size_t)layer->out; u++)
            memcpy(kept + disti_unit(net, l, u) * DISTI_BLOCK, delta + u * DISTI_BLOCK, DISTI_BLOCK * sizeof(float));
        float *d_x = disti_delta_room(net, b, l - 1, &fold);
        disti_linear_backward(shape, b, l, delta, d_x);
        disti_add_point_rows(layer, d_x, b->d_point);
        delta = d_x;
    }
    disti_encode_backward(shape, b);
}

/* Makes the worker's memory ready for blocks of n points in all. */
static void disti_blocks_begin(const dist_shape *shape, int worker, disti_block *b, size_t n)
{
    disti_block_layout(shape->net, disti_lane(shape->ctx, worker), b);
    b->channel = shape->net->sdf_channel;
    b->channels = 1;
    disti_counter_of(shape->ctx, worker)->dense += (double)dist_net_operations(shape->net, 1) * (double)n;
}

/* Loads up to B points into the block. */
static void disti_block_load(const dist_shape *shape, disti_block *b, size_t n, const float *points)
{
    b->columns = (int)n;
    disti_encode(shape->net, &shape->kernels, n, points, b->point);
}

/* Sums over no points yet. */
static void disti_fold_begin(const dist_net *net, disti_block *b)
{
    size_t rows = (size_t)net->fold_count * (size_t)net->max_rows;
    memset(b->fold_lanes, 0, rows * 16 * sizeof(float));
    memset(b->fold_sum, 0, rows * sizeof(double));
}

/* Parts to sums, before they get long. */
static void disti_fold_flush(const dist_net *net, disti_block *b)
{
    size_t rows = (size_t)net->fold_count * (size_t)net->max_rows;
    for (size_t o = 0; o < rows; o++) {
        const float *part = b->fold_lanes + 16 * o;
        double sum[4] = {0, 0, 0, 0};
        for (size_t c = 0; c < 16; c += 4)
            for (size_t i = 0; i < 4; i++) sum[i] += (double)part[c + i];
        b->fold_sum[o] += sum[0] + sum[1] + (sum[2] + sum[3]);
    }
    memset(b->fold_lanes, 0, rows * 16 * sizeof(float));
}

/* d_code += sum over the layers that see the code of scale W_code^T S,  S[o] = sum over points of delta[o], for `count`
   numbers of the net's code from `first`. */
static void disti_fold_backward(const dist_shape *shape, disti_block *b, size_t first, size_t count, double *d_code)
{
    const dist_net *net = shape->net;
    size_t fold = 0;
    disti_fold_flush(net, b);
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        if (!layer->code) continue;
        const double *sum = b->fold_sum + fold++ * (size_t)net->max_rows;
        size_t out = (size_t)(l + 1 == net->layers ? b->channels : layer->out);
        size_t row = l + 1 == net->layers ? (size_t)b->channel : 0;
        for (size_t o = 0; o < out; o++) {
            const float *w = net->params + layer->weight + disti_unit(net, l, row + o) * (size_t)layer->in;
            double s = sum[o] * (double)layer->scale;
            if (s != 0.0) shape->kernels.axpy(count, s, w + layer->code_column + first, d_code);
        }
    }
}

/* S += sum_c seed[c] delta[o][c], over the block's own lanes but tangents. seed NULL: ones. index: of the block. */
static void disti_fold_sum(const dist_shape *shape, disti_block *b, const float *seed, size_t index)
{
    const dist_net *net = shape->net;
    size_t fold = 0, width = (size_t)net->max_rows;
    int sparse = disti_net_plain(net);
    float ones[DISTI_BLOCK];
    for (size_t c = 0; c < DISTI_BLOCK && !seed; c++) ones[c] = 1.0f;
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        if (!layer->code) continue;
        int last = l + 1 == net->layers, rows = last ? b->channels : layer->out;
        int listed = !last && sparse && b->alive_units[l + 1] < rows;
        shape->kernels.lanes(seed ? seed : ones, b->fold_delta + fold * width * DISTI_BLOCK,
                             listed ? b->alive + (size_t)(l + 1) * width : NULL,
                             listed ? b->alive_units[l + 1] : rows, rows, b->columns - b->half,
                             b->fold_lanes + fold * width * 16);
        fold++;
    }
    if (index % 16 == 15) disti_fold_flush(net, b);
}

/* Points that are not finite, or with a seed that is not (n, each), add nothing to the code: 0 times NaN would. Returns
   whether there are any. */
static int disti_fold_drop(const dist_shape *shape, const disti_block *b, size_t n, const float *points, size_t each,
                           const float *seed)
{
    size_t rows = (size_t)shape->net->fold_count * (size_t)shape->net->max_rows;
    if (disti_finite_all(3 * n, points) && disti_finite_all(each * n, seed)) return 0;
    for (size_t c = 0; c < n; c++) {
        if (disti_finite_all(3, points + 3 * c) && disti_finite_all(each, seed + each * c)) continue;
        for (size_t row = 0; row < rows; row++) b->fold_delta[row * DISTI_BLOCK + c] = 0.0f;
    }
    return 1;
}

/* Whether n points go through kernels.few: not where a reverse pass needs what LayerNorm keeps. */
static int disti_net_few(const dist_shape *shape, const disti_block *b, size_t n)
{
    const dist_net *net = shape->net;
    return n <= (size_t)shape->kernels.few_points && (b->values || !net->normed) && net->layers > 1 &&
           !shape->ctx->blas.sgemm_fn;
}

/* Whether n points with their gradients do, where they are all that is asked for. */
static int disti_net_lone(const dist_shape *shape, size_t n)
{
    return n > 0 && n <= (size_t)shape->kernels.lone_points && shape->net->layers > 1 && !shape->ctx->blas.sgemm_fn;
}

/* How many of the n points that are left are evaluated next, at most a block: some counts go faster as parts, one of
   them of few points, where a layer is long enough to pay for a second pass over it. */
static size_t disti_net_part(const dist_shape *shape, const disti_block *b, size_t n)
{
    const disti_part *part = shape->kernels.parts;
    size_t block = DISTI_MIN(n, (size_t)DISTI_BLOCK);
    if (!part || !b->values || !shape->wide || !disti_net_plain(shape->net) || shape->ctx->blas.sgemm_fn) return block;
    while (part->least && n > (size_t)part->most) part++;
    return part->least && n >= (size_t)part->least ? (size_t)part->points : block;
}

/* Of few points' rows y (columns, stride) the first n numbers to (n, lanes), idle ones of DISTI_FEW_LANES repeating the
   last point. */
static void disti_few_turn(const dist_shape *shape, const disti_block *b, size_t n, size_t stride, const float *y,
                           size_t lanes, float *to)
{
    size_t u = 0, last = (size_t)b->columns - 1;
    const float *rows[DISTI_FEW_LANES];
    for (size_t c = 0; c < DISTI_FEW_LANES; c++) rows[c] = y + DISTI_MIN(c, last) * stride;
    for (; u + DISTI_BLOCK <= n; u += DISTI_BLOCK) {
        shape->kernels.transpose(rows, 1.0f, to + u * lanes, lanes);
        for (size_t c = 0; c < DISTI_FEW_LANES; c++) rows[c] += DISTI_BLOCK;
    }
    for (size_t c = 0; c < DISTI_FEW_LANES; c++)
        for (size_t k = u; k < n; k++) to[k * lanes + c] = rows[c][k - u];
}

/* The three tangents (3, stride) of a point's sums a to those of gamma h. */
static void disti_few_norm_tangents(size_t n, float epsilon, const float *gamma, const float *a, size_t stride,
                                    float *tangent)
{
    float *x = tangent, *y = x + stride, *z = y + stride;
    double mean = 0.0, square = 0.0, middle[3] = {0.0, 0.0, 0.0}, along[3] = {0.0, 0.0, 0.0}, share = 1.0 / (double)n;
    for (size_t u = 0; u < n; u++) {
        mean += (double)a[u];
        middle[0] += (double)x[u];
        middle[1] += (double)y[u];
        middle[2] += (double)z[u];
    }
    mean *= share;
    for (size_t u = 0; u < n; u++) {
        double d = (double)a[u] - mean;
        square += d * d;
        along[0] += d * (double)x[u];
        along[1] += d * (double)y[u];
        along[2] += d * (double)z[u];
    }
    double inverse = 1.0 / sqrt(square * share + (double)epsilon);
    for (int axis = 0; axis < 3; axis++, tangent += stride)
        for (size_t u = 0; u < n; u++)
            tangent[u] = gamma[u] * (float)(inverse * ((double)tangent[u] - share * middle[axis] -
                                            ((double)a[u] - mean) * inverse * inverse * share * along[axis]));
}

DISTI_LOOPS static void disti_few_slopes(size_t n, const float *DISTI_RESTRICT slope, float *DISTI_RESTRICT tangent)
{
    for (size_t u = 0; u < n; u++) tangent[u] = slope[u] == 0.0f ? 0.0f : slope[u] * tangent[u];
}

/* What follows few points' sums y (columns, stride) of hidden layer l where that is more than ReLU; sum tells which
   units are alive. The slopes go where a reverse pass reads them, or to the tangents: x' = phi'(a) a'; with LayerNorm
     h = (a - mean a) / sigma,  x = phi(gamma h + beta),
     h' = (a' - mean a' - h mean(h a')) / sigma,  x' = phi'(gamma h + beta) gamma h' */
DISTI_LOOPS static void disti_few_hidden(const dist_shape *shape, const disti_block *b, int l, size_t stride, float *y,
                                         float *sum)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    const float *gamma = net->params + layer->norm_weight;
    size_t out = (size_t)layer->out, whole = disti_round_up(out, 16); /* vectors, as blocks have them */
    size_t n = (size_t)(b->tangents ? b->tangents : b->columns);
    int relu = net->activation == DIST_ACTIVATION_RELU;
    float *turned = b->delta[1], *slope = b->values ? NULL : b->delta[1], *tangent = y + n * stride;
    if (net->normed) {
        for (size_t c = 0; c < (size_t)b->tangents; c++)
            disti_few_norm_tangents(out, net->norm_epsilon, gamma, y + c * stride, stride, tangent + 3 * c * stride);
        disti_few_turn(shape, b, out, stride, y, DISTI_FEW_LANES, turned);
        shape->kernels.norm_few(layer->out, (int)n, stride, net->norm_epsilon, gamma, net->params + layer->norm_bias,
                                turned, b->hat, y);
    }
    for (size_t c = 0; c < n; c++, y += stride) {
        float scale = l == 0 ? net->first_scale : net->scale, *own = slope ? slope + c * stride : NULL;
        for (size_t u = out; u < whole; u++) y[u] = 0.0f;
        shape->kernels.activate(net->activation, scale, whole, y, own);
        for (size_t u = 0; u < out; u++) sum[u] = relu ? (c > 0 ? sum[u] : 0.0f) + y[u] : 1.0f;
        for (int axis = 0; axis < 3 && b->tangents; axis++, tangent += stride) disti_few_slopes(out, own, tangent);
    }
    if (slope && !b->tangents)
        disti_few_turn(shape, b, out, stride, slope, DISTI_BLOCK,
                       b->slope + (size_t)l * (size_t)net->max_rows * DISTI_BLOCK);
}

/* disti_net_forward of a few points: activations stand (points, stride), so that weights fill the vectors. The last
   layer's input is put into rows, of which alive ones are written. With masks where a gradient is wanted. */
static const float *disti_few_forward(const dist_shape *shape, disti_block *b, disti_counter *counter)
{
    const dist_net *net = shape->net;
    size_t width = (size_t)net->max_rows, stride = disti_round_up(width, 16), points = (size_t)b->columns;
    int last = net->layers - 1, plain = disti_net_plain(net);
    float *sum = b->delta[0];
    double done = 0.0;
    for (int l = 0; l <= last; l++) {
        const disti_linear *layer = &net->layer[l];
        float *x = b->act[l & 1], *y = b->act[(l + 1) & 1];
        int *list = b->alive + (size_t)l * width, count = 0;
        for (int u = 0; u < layer->prev; u++) {
            list[count] = u;
            count += !(sum[u] <= 0.0f);
        }
        b->alive_units[l] = count;
        for (int i = 0; i < count && plain && !b->values && !b->tangents; i++) { /* for the way back */
            uint64_t *mask = b->mask + (size_t)l * width + list[i];
            *mask = 0;
            for (size_t c = 0; c < points; c++) *mask |= (uint64_t) !(x[c * stride + (size_t)list[i]] <= 0.0f) << c;
        }
        for (int i = 0; i < layer->point; i++, count++) {
            b->mask[(size_t)l * width + (size_t)(layer->prev + i)] = ~(uint64_t)0;
            list[count] = layer->prev + i;
            float *place = x + list[count];
            for (size_t c = 0; c < points; c++) place[c * stride] = b->point[i * DISTI_BLOCK + (int)c];
        }
        b->alive_count[l] = count;
        done += (double)count * layer->out;
        if (l == last) break;
        disti_few few = {net->panels + layer->panel, shape->bias + (size_t)l * width, x, list, y, sum, stride,
                         layer->prev + layer->point, count, layer->out, b->columns, plain && !b->tangents,
                         b->tangents ? b->tangents : DISTI_FEW_LANES};
        shape->kernels.few(&few);
        if (few.relu == 0) disti_few_hidden(shape, b, l, stride, y, sum);
    }
    counter->done += done * (b->tangents ? b->tangents : b->columns);
    const float *x = b->act[last & 1];
    const int *list = b->alive + (size_t)last * width;
    float *rows = b->act[(last & 1) ^ 1];
    for (int i = 0; i < b->alive_count[last]; i++) {
        float *row = rows + (size_t)list[i] * DISTI_BLOCK;
        for (size_t c = 0; c < points; c++) row[c] = x[c * stride + (size_t)list[i]];
        for (size_t c = points; c < DISTI_BLOCK; c++) row[c] = 0.0f;
    }
    return rows;
}

/* Value and gradient of so few points that three tangents of each go with them: then they cost the same as four times
   as many, and no reverse pass as of a block of sixteen follows. To b->value and b->pull. */
static void disti_few_gradient(const dist_shape *shape, disti_block *b, size_t n, const float *points,
                               disti_counter *counter)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[net->layers - 1];
    int last = net->layers - 1, rows = layer->prev + layer->point;
    const float *w = net->panels + layer->panel + (size_t)b->channel * (size_t)rows;
    disti_block_load(shape, b, n, points);
    for (size_t i = 0; i < 3 * n; i++) {
        const float u[3] = {i % 3 == 0 ? 1.0f : 0.0f, i % 3 == 1 ? 1.0f : 0.0f, i % 3 == 2 ? 1.0f : 0.0f};
        disti_encode_tangent(net, u, b->point + i / 3, n + i - i / 3);
    }
    b->tangents = (int)n;
    b->columns = 4 * b->tangents;
    const float *x = disti_few_forward(shape, b, counter);
    disti_net_output(shape, b, x, b->channel);
    shape->kernels.dot(w, 0.0f, x, b->alive + (size_t)last * (size_t)net->max_rows, b->alive_count[last], rows,
                       b->columns, b->seed);
    for (size_t i = 0; i < 3 * n; i++) b->pull[i] = b->value_slope[i / 3] * b->seed[n + i];
    b->tangents = 0;
}

/* Rows left out, too. A unit's pre-activation a(p) = b + sum_k w_k x_k(p) over a block of neighboring points is bounded
   from what the layer's inputs were there: with x_k(p) = A_k + J_k . (p - c) + e_k(p), |e_k| <= E_k, where J_k is
   whatever seems right and A_k and E_k are then the middle and half the range of x_k - J_k . (p - c) over the block,

     a(p) <= b + sum_k w_k A_k + max_p (sum_k w_k J_k) . (p - c) + sum_k |w_k| E_k

   The bound asks nothing of the layers before, whose outputs are known, so it does not loosen with depth. It costs five
   columns; the maximum is taken over boxes around a dozen points each. A unit for which it is negative is dead over the
   block and is not computed; rounding, of the sums here and of those left out, each at most 2 (K + 4) 2^-24 times the
   sum of the magnitudes of its K terms, is in E_k. So no bit of any result changes.
   J of a unit that is alive all over the block is sum_k w_k J_k; of one that changes sign, half of it.
   Up to four blocks go through each layer together, so that its weights come from memory once. */
enum {
    DISTI_GROUP = 4,
    DISTI_GROUP_POINTS = (int)DISTI_GROUP * DISTI_BLOCK,
    DISTI_GROUP_LEAST = 2 * DISTI_BLOCK, /* points: of fewer, bounds cost more than they save */
    DISTI_SORTED = 8 * (int)DISTI_GROUP_POINTS /* points put in order at once */
};

typedef struct disti_place { /* a point, and which it is */
    float p[3];
    int at;
} disti_place;

typedef struct disti_group {
    float *x[2][DISTI_GROUP]; /* (max_rows, B) each: a layer's input, of which alive rows and the point's are written */
    float *point, *away; /* (GROUP, 3, B): the points, and from their block's center */
    float *model;    /* (GROUP, max_rows, 8): of those rows, see disti_fit */
    float *sum;      /* (GROUP, 5, max_rows): of each output, see disti_bound */
    int *live;       /* max_rows: of each output, see disti_kernels */
    int *unit;       /* max_rows: those that are computed */
    uint64_t *mask;  /* (GROUP, layers, max_rows): as disti_block has them */
    int *alive;      /* (GROUP, layers, max_rows) */
    float *value;    /* (GROUP, 3, B): value, slope, curvature */
    disti_place *place; /* DISTI_SORTED: points in order */
    float *points;   /* (GROUP_POINTS, 3), in that order */
    float cell[DISTI_GROUP][6 * DISTI_CELLS], center[DISTI_GROUP][3], half[DISTI_GROUP][3];
    int alive_count[DISTI_GROUP][DISTI_MAX_LAYERS], alive_units[DISTI_GROUP][DISTI_MAX_LAYERS];
    int count[DISTI_GROUP]; /* of each block's points */
    int blocks;
} disti_group;

/* Returns the bytes needed, as disti_block_layout does; b: the worker's block, whose activations it shares. */
static size_t disti_group_layout(const dist_net *net, unsigned char *base, const disti_block *b, disti_group *g)
{
    size_t at = 0, rows = (size_t)net->max_rows, row = DISTI_BLOCK * sizeof(float), all = (size_t)net->layers * rows;
    memset(g, 0, sizeof *g);
    for (int j = 0; j < DISTI_GROUP; j++) { /* a reverse pass begins when these are done with */
        g->x[0][j] = (j < 2 ? b->act : b->delta)[j & 1];
        if (j >= net->fold_count) g->x[1][j] = (float *)disti_take(base, &at, rows, row);
        else g->x[1][j] = base ? b->fold_delta + (size_t)j * rows * DISTI_BLOCK : NULL;
    }
    g->point = (float *)disti_take(base, &at, DISTI_GROUP * 3, row);
    g->away = (float *)disti_take(base, &at, DISTI_GROUP * 3, row);
    g->model = (float *)disti_take(base, &at, DISTI_GROUP * rows * 8, sizeof(float));
    g->sum = (float *)disti_take(base, &at, DISTI_GROUP * rows * 5, sizeof(float));
    g->live = (int *)disti_take(base, &at, rows, sizeof(int));
    g->unit = (int *)disti_take(base, &at, rows, sizeof(int));
    g->mask = (uint64_t *)disti_take(base, &at, DISTI_GROUP * all, sizeof(uint64_t));
    g->alive = (int *)disti_take(base, &at, DISTI_GROUP * all, sizeof(int));
    g->value = (float *)disti_take(base, &at, DISTI_GROUP * 3, row);
    g->place = (disti_place *)disti_take(base, &at, DISTI_SORTED, sizeof(disti_place));
    g->points = (float *)disti_take(base, &at, DISTI_GROUP_POINTS * 3, sizeof(float));
    return at;
}

/* Whether bounds are tried: not where a BLAS takes the layers. */
static int disti_net_groups(const dist_context *ctx, const dist_net *net)
{
    int blas = ctx->blas.sgemm_fn && !net->unit_order && disti_net_narrowest(net) >= ctx->blas_width;
    return disti_net_sparse(net) && !blas;
}

/* The middle of n numbers and half their range, a little more than rounding takes away. */
static void disti_middle(int n, const float *x, float *middle, float *half)
{
    float low = 3e38f, high = -3e38f;
    for (int i = 0; i < n; i++) {
        low = DISTI_MIN(low, x[i]);
        high = DISTI_MAX(high, x[i]);
    }
    *middle = 0.5f * (low + high);
    *half = 0.50001f * (high - low);
}

/* Makes the group of n points (n, 3) ready: their rows, idle lanes repeating the last point, and their boxes. */
static void disti_group_begin(const dist_shape *shape, disti_group *g, int n, const float *points)
{
    g->blocks = (n + DISTI_BLOCK - 1) / DISTI_BLOCK;
    for (int j = 0; j < g->blocks; j++, points += 3 * DISTI_BLOCK) {
        int count = DISTI_MIN(n - j * DISTI_BLOCK, (int)DISTI_BLOCK);
        float *point = g->point + j * 3 * DISTI_BLOCK, *away = g->away + j * 3 * DISTI_BLOCK;
        g->count[j] = count;
        disti_encode(shape->net, &shape->kernels, (size_t)count, points, point);
        for (int k = 0; k < 3; k++, point += DISTI_BLOCK, away += DISTI_BLOCK) {
            disti_middle(DISTI_BLOCK, point, &g->center[j][k], &g->half[j][k]);
            for (int i = 0; i < DISTI_BLOCK; i++) away[i] = point[i] - g->center[j][k];
            for (int i = 0; i < DISTI_CELLS; i++)
                disti_middle(DISTI_CELL_POINTS, away + i * DISTI_CELL_POINTS, &g->cell[j][6 * i + k],
                             &g->cell[j][6 * i + 3 + k]);
        }
    }
}

/* Layer l's input of block j, of which `units` rows listed in g->unit were computed: the list of the alive ones, then
   the point's, which it writes, and their model, where a layer follows whose units are bounded by it. */
static void disti_group_input(const dist_shape *shape, disti_group *g, int l, int j, int units, float slack)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t width = (size_t)net->max_rows, at = ((size_t)j * (size_t)net->layers + (size_t)l) * width;
    float *x = g->x[l & 1][j], *model = g->model + (size_t)j * width * 8;
    const float *point = g->point + j * 3 * DISTI_BLOCK;
    uint64_t *mask = g->mask + at;
    int *alive = g->alive + at, count = 0;
    const int *unit = g->unit;
    for (int i = 0; i < units; i++) {
        alive[count] = unit[i];
        count += mask[unit[i]] != 0;
    }
    const float *half = g->half[j];
    disti_fit fit = {alive, x, g->away + j * 3 * DISTI_BLOCK, g->sum + (size_t)j * 5 * width, mask, model, width,
                     {half[0], half[1], half[2]}, slack, count, (g->count[j] + 15) / 16 * 16};
    if (l + 1 < net->layers) shape->kernels.fit(&fit);
    g->alive_units[j][l] = count;
    for (int i = 0; i < layer->point; i++, count++) {
        float *m = model + (size_t)count * 8, c = g->center[j][i];
        alive[count] = layer->prev + i;
        mask[layer->prev + i] = ~(uint64_t)0;
        memcpy(x + (size_t)(layer->prev + i) * DISTI_BLOCK, point + i * DISTI_BLOCK, DISTI_BLOCK * sizeof(float));
        m[0] = c;
        for (int k = 0; k < 3; k++) m[1 + k] = i == k ? 1.0f : 0.0f;
        m[4] = slack * (half[i] + fabsf(c));
    }
    g->alive_count[j][l] = count;
}

/* All hidden layers of a group of n points; disti_group_block then gives its blocks. Returns the multiply-adds. */
static double disti_group_forward(const dist_shape *shape, disti_group *g, int n, const float *points)
{
    const dist_net *net = shape->net;
    int last = net->layers - 1, count[DISTI_GROUP];
    float slack = 5e-7f * (float)(net->max_rows + 16); /* twice 4 (K + 4) 2^-24 */
    double done = 0.0;
    size_t width = (size_t)net->max_rows, all = (size_t)net->layers * width;
    disti_group_begin(shape, g, n, points);
    for (int j = 0; j < g->blocks; j++) disti_group_input(shape, g, 0, j, 0, slack);
    for (int l = 0; l < last; l++) {
        const disti_linear *layer = &net->layer[l];
        const float *weights = net->panels + layer->panel, *bias = shape->bias + (size_t)l * width;
        int rows = layer->prev + layer->point, out = layer->out;
        for (int j = 0; j < g->blocks; j++) count[j] = g->alive_count[j][l];
        disti_bound bound = {weights, g->alive + (size_t)l * width, count, g->model, g->sum, width, all, rows, out,
                             g->blocks};
        shape->kernels.bound(&bound);
        for (int j = 0; j < g->blocks; j++) {
            size_t block = (size_t)j * width, at = (size_t)j * all + (size_t)l * width;
            const int *live = g->live;
            int units = 0, columns = (g->count[j] + 15) / 16 * 16, *unit = g->unit;
            disti_gemm m = {weights, bias, g->x[l & 1][j], g->x[(l + 1) & 1][j], g->alive + at, g->mask + at + width,
                            rows, count[j], out, columns, 1};
            shape->kernels.live((size_t)out, g->sum + 5 * block, width, bias, slack, g->cell[j], g->live);
            for (int o = 0; o < out; o++) {
                unit[units] = o;
                units += live[o];
            }
            shape->kernels.gemm_some(&m, unit, units);
            done += (double)count[j] * (5.0 * (double)layer->out + (double)units * (double)g->count[j]);
            disti_group_input(shape, g, l + 1, j, units, slack);
        }
    }
    for (int j = 0; j < g->blocks; j++) done += (double)g->alive_count[j][last] * (double)g->count[j];
    return done;
}

/* Block j of the group to a copy of the worker's block. Returns the last layer's input. */
static const float *disti_group_block(const dist_net *net, const disti_group *g, int j, disti_block *b)
{
    size_t width = (size_t)net->max_rows, at = (size_t)j * (size_t)net->layers * width;
    b->point = g->point + j * 3 * DISTI_BLOCK;
    b->mask = g->mask + at;
    b->alive = g->alive + at;
    b->value = g->value + j * 3 * DISTI_BLOCK;
    b->value_slope = b->value + DISTI_BLOCK;
    b->value_curvature = b->value_slope + DISTI_BLOCK;
    memcpy(b->alive_count, g->alive_count[j], sizeof b->alive_count);
    memcpy(b->alive_units, g->alive_units[j], sizeof b->alive_units);
    b->columns = g->count[j];
    return g->x[(net->layers - 1) & 1][j];
}

/* dist_field.fused_fn of a net. The reverse pass runs from f's own slope (seed 1), so that it leaves grad f; delta
   is linear in the seed, so the seeds may come afterwards: d_code needs only sum_c seed[c] delta[.][c]. */
static void disti_shape_fused(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient,
                              dist_seed_fn seed_fn, void *seed_user, double *d_code)
{
    const dist_shape *shape = (const dist_shape *)user;
    const dist_net *net = shape->net;
    disti_counter *counter = disti_counter_of(shape->ctx, worker);
    disti_block own, b, *block; /* b: of a group */
    disti_group g;
    int blocks = 0, j = 0;
    disti_blocks_begin(shape, worker, &own, n);
    own.values = !gradient && !seed_fn;
    if (gradient && !seed_fn && disti_net_lone(shape, n)) {
        disti_few_gradient(shape, &own, n, points, counter);
        if (sdf) memcpy(sdf, own.value, n * sizeof(float));
        memcpy(gradient, own.pull, 3 * n * sizeof(float));
        if (disti_finite_all(3 * n, gradient)) return; /* else f's own slope, which may be 0, has to come first */
    }
    if (shape->groups) {
        size_t bytes = disti_block_layout(net, NULL, &b);
        disti_group_layout(net, disti_lane(shape->ctx, worker) + bytes, &own, &g);
    }
    if (d_code) disti_fold_begin(net, &own);
    for (size_t at = 0, count; at < n; at += count, j++) {
        count = DISTI_MIN(n - at, (size_t)DISTI_BLOCK);
        int part = (int)DISTI_MIN(n - at, (size_t)DISTI_GROUP_POINTS);
        if (j >= blocks && shape->groups > own.values && n - at >= DISTI_GROUP_LEAST &&
            disti_finite_all(3 * (size_t)part, points + 3 * at)) { /* no bound around a point that is not */
            counter->done += disti_group_forward(shape, &g, part, points + 3 * at);
            blocks = g.blocks;
            for (j = 0; j < blocks; j++) { /* all, before a reverse pass takes the memory of their inputs */
                b = own;
                const float *x = disti_group_block(net, &g, j, &b);
                disti_net_output(shape, &b, x, net->sdf_channel);
            }
            j = 0;
        }
        block = &own;
        if (j < blocks) {
            b = own;
            block = &b;
            disti_group_block(net, &g, j, block);
        } else {
            count = disti_net_part(shape, block, n - at);
            disti_block_load(shape, block, count, points + 3 * at);
            const float *x = disti_net_few(shape, block, count) ? disti_few_forward(shape, block, counter)
                                                                : disti_net_forward(shape, block, NULL, counter);
            disti_net_output(shape, block, x, net->sdf_channel);
        }
        if (sdf) memcpy(sdf + at, block->value, count * sizeof(float));
        if (own.values) continue;
        disti_net_reverse(shape, block, block->value_slope, NULL);
        if (gradient) memcpy(gradient + 3 * at, own.pull, 3 * count * sizeof(float));
        if (!seed_fn) continue;
        seed_fn(seed_user, at, count, block->value, own.pull, own.seed);
        if (!d_code) continue;
        int dropped = disti_fold_drop(shape, block, count, points + 3 * at, 1, own.seed);
        for (size_t c = 0; dropped && c < count; c++) own.seed[c] = disti_finite(own.seed[c]) ? own.seed[c] : 0.0f;
        disti_fold_sum(shape, block, own.seed, at / DISTI_BLOCK);
    }
    if (d_code) disti_fold_backward(shape, &own, 0, (size_t)net->code_size, d_code);
}

#ifndef DIST_NO_BACKWARD
/* Second order. A block carries B / 2 points p with directions u in two lanes each: lane c is the value, lane c + B / 2
   its tangent, the derivative along u. Every matrix serves both, in the sums for the weights too.
   forward   a_l = W_l x_l + b_l,  a'_l = W_l x'_l,  x_l+1 = phi(a_l),  x'_l+1 = phi'(a_l) a'_l;  at the end
             f = out(a),  s = out'(a) a' = u . grad f
   backward  of s, with d = dL/d(pre-activation) and d' that of the tangent:  d = out''(a) a',  d' = out'(a);
             X = W_l^T d_l,  X' = W_l^T d'_l,  d_l-1 = phi'(a) X + phi''(a) a' X',  d'_l-1 = phi'(a) X'
             d_W_l = sum d x^T + d' x'^T,  d_b_l = sum d,  and the code's columns like the bias: its tangent is 0
   Leaves d_b of the layers that see the code in b->fold_delta's lanes c, and ds/dp = H u (B / 2, 3) in b->pull. */
static void disti_second_block(const dist_shape *shape, int worker, disti_block *b, size_t n, const float *points,
                               const float *directions, float *store)
{
    const dist_net *net = shape->net;
    disti_block_load(shape, b, n, points);
    b->half = DISTI_BLOCK / 2;
    b->columns = DISTI_BLOCK; /* idle lanes repeat the last point with u = 0 and the seeds 0 */
    for (size_t c = 0; c < DISTI_BLOCK / 2; c++) {
        const float none[3] = {0.0f, 0.0f, 0.0f};
        disti_encode_tangent(net, c < n ? directions + 3 * c : none, b->point + c, DISTI_BLOCK / 2);
    }
    const float *x = disti_net_forward(shape, b, store, disti_counter_of(shape->ctx, worker));
    disti_net_output(shape, b, x, net->sdf_channel);
    memset(b->seed, 0, DISTI_BLOCK * sizeof(float));
    for (size_t c = 0; c < n; c++) {
        b->seed[c] = b->value_curvature[c] * b->value[DISTI_BLOCK / 2 + c];
        b->seed[DISTI_BLOCK / 2 + c] = b->value_slope[c];
    }
    disti_net_reverse(shape, b, b->seed, store);
}

/* dist_field.second_fn of a net. */
static void disti_shape_second(void *user, int worker, size_t n, const float *points, const float *directions,
                               float *d_points, double *d_code)
{
    const dist_shape *shape = (const dist_shape *)user;
    const dist_net *net = shape->net;
    disti_block b;
    disti_blocks_begin(shape, worker, &b, n);
    if (d_code) disti_fold_begin(net, &b);
    for (size_t at = 0; at < n; at += DISTI_BLOCK / 2) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_BLOCK / 2);
        disti_second_block(shape, worker, &b, count, points + 3 * at, directions + 3 * at, NULL);
        for (size_t i = 0; d_points && i < 3 * count; i++) d_points[3 * at + i] += b.pull[i];
        if (d_code) disti_fold_sum(shape, &b, NULL, at / DISTI_BLOCK);
    }
    if (d_code) disti_fold_backward(shape, &b, 0, (size_t)net->code_size, d_code);
}
#endif

/* A BLAS wants wider matrices than our blocks: values alone go through its layers this many blocks at a time. */
enum { DISTI_WIDE = 8, DISTI_WIDE_COLUMNS = DISTI_WIDE * DISTI_BLOCK };

/* Floats of scratch for that; 0 for a net with a hidden layer that is too narrow or normed, or without a BLAS. */
static size_t disti_wide_floats(const dist_context *ctx, const dist_net *net)
{
    for (int l = 1; l + 1 < net->layers; l++)
        if (DISTI_MIN(net->layer[l].out, net->layer[l].prev) < ctx->blas_width) return 0;
    if (!ctx->blas.sgemm_fn || net->unit_order || net->normed || net->layers < 3) return 0;
    return (size_t)(2 * net->max_rows + net->point_size) * DISTI_WIDE_COLUMNS;
}

/* Hidden layer l by the BLAS: y = activation(W x + W_point point + bias), rows of DISTI_WIDE_COLUMNS. */
static void disti_wide_hidden(const dist_shape *shape, int l, int columns, const float *x, const float *point, float *y)
{
    const dist_net *net = shape->net;
    uint64_t mask[DISTI_WIDE];
    disti_linear_blas(shape, l, shape->bias + (size_t)l * (size_t)net->max_rows, columns, DISTI_WIDE_COLUMNS, x, point,
                      y);
    for (size_t o = 0; o < (size_t)net->layer[l].out; o++) {
        float *row = y + o * DISTI_WIDE_COLUMNS;
        if (net->activation == DIST_ACTIVATION_RELU) shape->kernels.relu((size_t)(columns / DISTI_BLOCK), row, mask);
        else shape->kernels.activate(net->activation, net->scale, (size_t)columns, row, NULL);
    }
}

/* One block's rows from a matrix of the stride `from` to one of the stride `to`. */
static void disti_copy_rows(size_t rows, const float *x, size_t from, float *y, size_t to)
{
    for (size_t u = 0; u < rows; u++) memcpy(y + u * to, x + u * from, DISTI_BLOCK * sizeof(float));
}

static void disti_wide_eval(const dist_shape *shape, int worker, size_t n, const float *points, float *sdf)
{
    const dist_net *net = shape->net;
    const disti_linear *last = &net->layer[net->layers - 1];
    disti_block b;
    size_t bytes = disti_block_layout(net, NULL, &b), stride = DISTI_WIDE_COLUMNS;
    float *point = (float *)(void *)(disti_lane(shape->ctx, worker) + bytes);
    float *wide[2];
    wide[0] = point + (size_t)net->point_size * stride;
    wide[1] = wide[0] + (size_t)net->max_rows * stride;
    disti_blocks_begin(shape, worker, &b, n);
    b.values = 1;
    for (size_t at = 0; at < n; at += stride) {
        size_t count = DISTI_MIN(n - at, stride), blocks = (count + DISTI_BLOCK - 1) / DISTI_BLOCK;
        for (size_t j = 0; j < blocks; j++) {
            size_t first = at + j * DISTI_BLOCK;
            disti_block_load(shape, &b, DISTI_MIN(n - first, (size_t)DISTI_BLOCK), points + 3 * first);
            b.columns = DISTI_BLOCK;
            disti_list_alive(shape, &b, 0);
            disti_hidden(shape, &b, 0, b.point, b.act[0]);
            disti_copy_rows((size_t)net->layer[0].out, b.act[0], DISTI_BLOCK, wide[0] + j * DISTI_BLOCK, stride);
            disti_copy_rows((size_t)net->point_size, b.point, DISTI_BLOCK, point + j * DISTI_BLOCK, stride);
        }
        for (int l = 1; l + 1 < net->layers; l++)
            disti_wide_hidden(shape, l, (int)(blocks * DISTI_BLOCK), wide[(l - 1) & 1], point, wide[l & 1]);
        for (size_t j = 0; j < blocks; j++) {
            size_t first = at + j * DISTI_BLOCK;
            b.alive_count[net->layers - 1] = last->prev + last->point;
            disti_copy_rows((size_t)last->prev, wide[net->layers & 1] + j * DISTI_BLOCK, stride, b.act[0], DISTI_BLOCK);
            disti_copy_rows((size_t)last->point, point + j * DISTI_BLOCK, stride,
                            b.act[0] + (size_t)last->prev * DISTI_BLOCK, DISTI_BLOCK);
            disti_net_output(shape, &b, b.act[0], net->sdf_channel);
            memcpy(sdf + first, b.value, DISTI_MIN(n - first, (size_t)DISTI_BLOCK) * sizeof(float));
        }
    }
    disti_counter_of(shape->ctx, worker)->done += (double)dist_net_operations(net, 1) * (double)n;
}

static void disti_places_init(disti_place *place, const float *points, int n)
{
    for (int i = 0; i < n; i++) {
        memcpy(place[i].p, points + 3 * i, 3 * sizeof(float));
        place[i].at = i;
    }
}

/* The axis along which n places reach farthest. */
static int disti_places_axis(const disti_place *place, int n)
{
    float x0 = 3e38f, y0 = 3e38f, z0 = 3e38f, x1 = -3e38f, y1 = -3e38f, z1 = -3e38f;
    for (int i = 0; i < n; i++) {
        const float *p = place[i].p;
        x0 = DISTI_MIN(x0, p[0]), x1 = DISTI_MAX(x1, p[0]);
        y0 = DISTI_MIN(y0, p[1]), y1 = DISTI_MAX(y1, p[1]);
        z0 = DISTI_MIN(z0, p[2]), z1 = DISTI_MAX(z1, p[2]);
    }
    return x1 - x0 >= y1 - y0 ? (x1 - x0 >= z1 - z0 ? 0 : 2) : y1 - y0 >= z1 - z0 ? 1 : 2;
}

/* Puts those of place[a..b] below the limit, or also those at it, before the others; returns where these begin. Without
   a branch on what is compared, which no processor could foretell. */
static int disti_places_part(disti_place *place, int a, int b, int axis, float limit, int also)
{
    int to = a;
    for (int i = a; i <= b; i++) {
        disti_place moved = place[i];
        float x = moved.p[axis];
        place[i] = place[to];
        place[to] = moved;
        to += (x < limit) | (also & (x <= limit));
    }
    return to;
}

/* Puts place[begin..end-1] such that neighbors stand together: cut across the longest side of their box, in whole
   groups, blocks, cells. Pieces of `least` places, a cell's or a multiple of a group's, are left as they are. */
static void disti_sort_places(disti_place *place, int begin, int end, int least)
{
    while (end - begin > least) {
        int n = end - begin, axis = disti_places_axis(place + begin, n);
        int unit = n > DISTI_GROUP_POINTS ? DISTI_MAX((int)DISTI_GROUP_POINTS, least)
                   : n > DISTI_BLOCK      ? (int)DISTI_BLOCK
                                          : (int)DISTI_CELL_POINTS;
        int middle = begin + (n / unit + 1) / 2 * unit, a = begin, b = end - 1;
        if (middle >= end) middle = end - unit;
        while (a < b) { /* selection of the place at `middle`, by the median of three */
            float x = place[a].p[axis], y = place[a + (b - a) / 2].p[axis], z = place[b].p[axis];
            float limit = DISTI_MAX(DISTI_MIN(x, y), DISTI_MIN(DISTI_MAX(x, y), z));
            int from = disti_places_part(place, a, b, axis, limit, 0);
            if (middle < from) {
                b = from - 1;
                continue;
            }
            if (from == a) { /* it is the least: those alike stand first */
                from = disti_places_part(place, a, b, axis, limit, 1);
                if (middle < from || from == a) break; /* the latter: not finite */
            }
            a = from;
        }
        disti_sort_places(place, begin, middle, least);
        begin = middle;
    }
}

/* f at n points of a wide net, in the order of neighbors: blocks of these share dead units. */
static void disti_neighbors_eval(void *user, int worker, size_t n, const float *points, float *sdf)
{
    const dist_shape *shape = (const dist_shape *)user;
    disti_block b;
    disti_group g;
    size_t bytes = disti_block_layout(shape->net, disti_lane(shape->ctx, worker), &b);
    float value[DISTI_GROUP_POINTS];
    disti_group_layout(shape->net, disti_lane(shape->ctx, worker) + bytes, &b, &g);
    for (size_t at = 0; at < n; at += DISTI_SORTED) {
        int count = (int)DISTI_MIN(n - at, (size_t)DISTI_SORTED);
        disti_places_init(g.place, points + 3 * at, count);
        disti_sort_places(g.place, 0, count, DISTI_CELL_POINTS);
        for (int first = 0; first < count; first += DISTI_GROUP_POINTS) {
            int part = DISTI_MIN(count - first, (int)DISTI_GROUP_POINTS);
            const disti_place *place = g.place + first;
            for (int i = 0; i < part; i++) memcpy(g.points + 3 * i, place[i].p, 3 * sizeof(float));
            disti_shape_fused(user, worker, (size_t)part, g.points, value, NULL, NULL, NULL, NULL);
            for (int i = 0; i < part; i++) sdf[at + (size_t)place[i].at] = value[i];
        }
    }
}

static void disti_shape_eval_fn(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const dist_shape *shape = (const dist_shape *)user;
    if (!gradient && disti_wide_floats(shape->ctx, shape->net) > 0) disti_wide_eval(shape, worker, n, points, sdf);
    else if (!gradient && shape->groups && shape->wide && n > DISTI_FEW_POINTS)
        disti_neighbors_eval(user, worker, n, points, sdf);
    else disti_shape_fused(user, worker, n, points, sdf, gradient, NULL, NULL, NULL);
}

#ifdef DISTI_HALF
/* Hidden layer l of 96 points (f16) or 48 (bf16), x to y. */
static void disti_half_hidden(const dist_shape *shape, const disti_block *b, int l, disti_half *h)
{
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    size_t rows = (size_t)(layer->prev + layer->point);
    int last = l + 2 == net->layers, pairs = net->half == DIST_HALF_BF16;
    h->steps = pairs ? (layer->prev + 1) / 2 : layer->prev;
    h->weights = net->half_panels ? net->half_panels + layer->half_panel : net->panels; /* steps is 0: not read */
    h->point_weights = net->panels + layer->panel + (size_t)layer->prev * 8;
    h->panel = rows * 8;
    h->point = layer->point;
    h->bias = shape->bias + (size_t)l * (size_t)net->max_rows;
    h->x = b->act[l & 1];
    h->y = b->act[(l & 1) ^ 1];
    h->alive_count = h->y_alive_count;
    h->alive = h->alive_count < h->steps ? b->alive + (size_t)l * (size_t)net->max_rows : NULL;
    h->y_alive = b->alive + (size_t)(l + 1) * (size_t)net->max_rows;
    h->y_alive_count = 0;
    h->last[0] = last ? b->delta[0] : NULL;
    h->last[1] = last ? b->delta[1] : NULL;
    h->activate = net->activation == DIST_ACTIVATION_RELU ? NULL : shape->kernels.activate;
    h->activation = net->activation;
    h->scale = l == 0 ? net->first_scale : net->scale;
    h->out = layer->out;
    if (pairs) disti_half_bf16(h);
    else disti_half_f16(h);
}

/* dist_field.coarse_fn of a net: the hidden layers in 16 bits; a block with a sum that is not finite again in f32. */
static void disti_shape_coarse(void *user, int worker, size_t n, const float *points, float *sdf, float *gradient)
{
    const dist_shape *shape = (const dist_shape *)user;
    const dist_net *net = shape->net;
    const disti_linear *last = &net->layer[net->layers - 1];
    size_t wide = net->half == DIST_HALF_F16 ? 2 * DISTI_BLOCK : DISTI_BLOCK;
    if (gradient || !net->half) {
        disti_shape_fused(user, worker, n, points, sdf, gradient, NULL, NULL, NULL);
        return;
    }
    disti_block b;
    disti_blocks_begin(shape, worker, &b, n);
    b.values = 1;
    for (size_t at = 0; at < n; at += wide) {
        size_t count = DISTI_MIN(n - at, wide), first = DISTI_MIN(count, (size_t)DISTI_BLOCK);
        disti_half h;
        memset(&h, 0, sizeof h);
        disti_block_load(shape, &b, first, points + 3 * at);
        if (wide > DISTI_BLOCK) /* idle lanes repeat a point here too */
            disti_encode(net, &shape->kernels, count > first ? count - first : 1,
                         points + 3 * (at + (count > first ? first : 0)), b.d_point);
        h.points[0] = b.point;
        h.points[1] = b.d_point;
        h.columns = (int)count;
        double done = (double)dist_net_operations(net, 1);
        for (int l = 0; l + 1 < net->layers; l++) {
            disti_half_hidden(shape, &b, l, &h);
            /* whole numbers: sums of any order are the same */
            done -= (double)((h.steps - h.alive_count) * net->layer[l].prev / DISTI_MAX(h.steps, 1)) * h.out;
        }
        disti_counter_of(shape->ctx, worker)->done += done * (double)count;
        b.alive_count[net->layers - 1] = last->prev + last->point;
        for (size_t from = 0, k = 0; from < count && !h.bad; from += DISTI_BLOCK, k++) {
            b.columns = (int)DISTI_MIN(count - from, (size_t)DISTI_BLOCK);
            memcpy(b.delta[k] + (size_t)last->prev * DISTI_BLOCK, h.points[k],
                   (size_t)last->point * DISTI_BLOCK * sizeof(float));
            disti_net_output(shape, &b, b.delta[k], net->sdf_channel);
            memcpy(sdf + at + from, b.value, (size_t)b.columns * sizeof(float));
        }
        if (h.bad) disti_shape_fused(user, worker, count, points + 3 * at, sdf + at, NULL, NULL, NULL, NULL);
    }
}
#endif

/* All channels (n, channels), or `count` of them from `first`. */
static void disti_shape_channels(const dist_shape *shape, int worker, size_t n, const float *points, int first,
                                 int count, float *channels)
{
    disti_block b;
    disti_blocks_begin(shape, worker, &b, n);
    b.values = 1;
    for (size_t at = 0; at < n; at += DISTI_BLOCK) {
        size_t columns = DISTI_MIN(n - at, (size_t)DISTI_BLOCK);
        disti_block_load(shape, &b, columns, points + 3 * at);
        const float *x = disti_net_forward(shape, &b, NULL, disti_counter_of(shape->ctx, worker));
        for (int k = 0; k < count; k++) {
            disti_net_output(shape, &b, x, first + k);
            for (size_t c = 0; c < columns; c++) channels[(at + c) * (size_t)count + (size_t)k] = b.value[c];
        }
    }
}

/* The shape whose net gives the color: the texture, or the shape itself. */
static const dist_shape *disti_shape_paint(const void *user)
{
    const dist_shape *shape = (const dist_shape *)user;
    return shape->texture ? shape->texture : shape;
}

static void disti_shape_color_fn(void *user, int worker, size_t n, const float *points, float *color)
{
    const dist_shape *paint = disti_shape_paint(user);
    disti_shape_channels(paint, worker, n, points, paint->net->color_channel, 3, color);
}

#ifndef DIST_NO_BACKWARD
/* Forward and reverse pass of one block from dL/d(r, g, b); leaves what disti_net_reverse does. */
static void disti_color_reverse(const dist_shape *paint, int worker, disti_block *b, size_t n, const float *d_color,
                                float *store)
{
    const float *x = disti_net_forward(paint, b, store, disti_counter_of(paint->ctx, worker));
    b->channel = paint->net->color_channel;
    b->channels = 3;
    for (int k = 0; k < 3; k++) {
        disti_net_output(paint, b, x, b->channel + k);
        for (size_t c = 0; c < DISTI_BLOCK; c++)
            b->seed[k * DISTI_BLOCK + (int)c] = c < n ? d_color[3 * c + (size_t)k] * b->value_slope[c] : 0.0f;
    }
    disti_net_reverse(paint, b, b->seed, store);
}

/* dist_field.color_adjoint_fn of a net. A texture's code is the shape's, then the color's: so are their columns. */
static void disti_shape_color_adjoint_fn(void *user, int worker, size_t n, const float *points, const float *d_color,
                                         float *d_points, double *d_code, double *d_color_code)
{
    const dist_shape *paint = disti_shape_paint(user);
    const dist_net *net = paint->net;
    size_t own = (size_t)((const dist_shape *)user)->net->code_size;
    disti_block b;
    disti_blocks_begin(paint, worker, &b, n);
    disti_fold_begin(net, &b);
    for (size_t at = 0; at < n; at += DISTI_BLOCK) {
        size_t count = DISTI_MIN(n - at, (size_t)DISTI_BLOCK);
        disti_block_load(paint, &b, count, points + 3 * at);
        disti_color_reverse(paint, worker, &b, count, d_color + 3 * at, NULL);
        for (size_t i = 0; d_points && i < 3 * count; i++)
            if (disti_finite(b.pull[i])) d_points[3 * at + i] += b.pull[i];
        if (!d_code && !d_color_code) continue;
        disti_fold_drop(paint, &b, count, points + 3 * at, 3, d_color + 3 * at);
        disti_fold_sum(paint, &b, NULL, at / DISTI_BLOCK);
    }
    if (d_code) disti_fold_backward(paint, &b, 0, own, d_code);
    if (d_color_code) disti_fold_backward(paint, &b, own, (size_t)net->code_size - own, d_color_code);
}
#endif

#ifndef DIST_NO_TRAIN
/* Weight gradients go in two phases over a chunk of blocks, so that no partial sums are needed and the bits do not
   depend on the threads: blocks in parallel leave inputs and deltas in the store; then rows of weights in parallel add
       dW[o][k] += sum over points of delta[o] x[k],   db[o] += sum of delta[o],   dW[o][code] += db[o] code. */
typedef struct disti_weights_job {
    const dist_shape *shape;
    size_t n;
    const float *points;
    const float *d_color; /* (n, 3): the channels are r, g, b; NULL: the distance, and what follows is about it */
    const float *directions; /* not NULL: of second_weights_fn */
    float *d_sdf;
    dist_seed_fn seed_fn;
    void *seed_user;
    float *d_points;
    double *d_code; /* (blocks of the chunk, code_size) or NULL */
    float *d_weights;
    size_t first, block; /* points of a block: B, or B / 2 with directions */
    int blocks;
} disti_weights_job;

/* Points whose numbers somewhere in the net are so large that their products overflow give no weight gradient, rather
   than spoil that of all the others: their inputs and deltas in the store become 0. channels: the store's of the last
   layer. The first pass asks whether there is such a number at all, the second marks points, the third clears them. */
static void disti_weights_drop(const dist_shape *shape, size_t columns, size_t channels, float *store)
{
    const dist_net *net = shape->net;
    unsigned char bad[DISTI_BLOCK];
    int huge = 0;
    memset(bad, 0, sizeof bad);
    for (int pass = 0; pass < 1 + 2 * huge; pass++) {
        for (int l = 0; l < net->layers; l++) {
            const disti_linear *layer = &net->layer[l];
            size_t rows = l + 1 == net->layers ? channels : (size_t)layer->out;
            size_t wide = (size_t)(layer->prev + layer->point);
            float *xt = store + disti_store_offset(net, l, DISTI_STORE_INPUT);
            float *delta = store + disti_store_offset(net, l, DISTI_STORE_DELTA);
            float *sums = store + disti_store_offset(net, l, DISTI_STORE_NORM);
            size_t sum_count = net->normed ? 2 * disti_store_out(layer) : 0;
            if (pass == 0) {
                huge = huge || shape->kernels.huge(columns * disti_store_stride(layer), xt) ||
                       shape->kernels.huge(rows * DISTI_BLOCK, delta) || shape->kernels.huge(sum_count, sums);
                continue;
            }
            for (size_t c = 0; c < columns; c++) {
                float *x = xt + c * disti_store_stride(layer);
                for (size_t k = 0; k < wide; k++)
                    if (pass == 2 && bad[c]) x[k] = 0.0f;
                    else bad[c] |= disti_is_huge(x[k]);
            }
            for (size_t o = 0; o < rows; o++)
                for (size_t c = 0; c < columns; c++)
                    if (pass == 2 && bad[c]) delta[o * DISTI_BLOCK + c] = 0.0f;
                    else bad[c] |= disti_is_huge(delta[o * DISTI_BLOCK + c]);
            for (size_t i = 0; i < sum_count; i++)
                if (disti_is_huge(sums[i])) sums[i] = 0.0f;
        }
    }
}

static void disti_weights_block(void *arg, int index, int worker)
{
    const disti_weights_job *job = (const disti_weights_job *)arg;
    const dist_shape *shape = job->shape;
    const dist_net *net = shape->net;
    disti_block b;
    size_t at = job->first + (size_t)index * job->block;
    size_t count = DISTI_MIN(job->n - at, job->block);
    float *store = shape->ctx->store + (size_t)index * shape->store_block_size;
    float points[3 * DISTI_BLOCK], d_color[3 * DISTI_BLOCK];
    for (size_t c = 0; c < count; c++) { /* what is not finite becomes a point without a seed, which adds nothing */
        const float *p = job->points + 3 * (at + c), *d = job->d_color ? job->d_color + 3 * (at + c) : p;
        int good = disti_finite_all(3, p) && disti_finite_all(3, d);
        for (size_t k = 0; k < 3; k++) {
            points[3 * c + k] = good ? p[k] : 0.0f;
            d_color[3 * c + k] = good ? d[k] : 0.0f;
        }
    }
    disti_blocks_begin(shape, worker, &b, count);
    if (job->directions) {
        disti_second_block(shape, worker, &b, count, job->points + 3 * at, job->directions + 3 * at, store);
    } else {
        disti_block_load(shape, &b, count, points);
        if (job->d_color) {
            disti_color_reverse(shape, worker, &b, count, d_color, store);
        } else {
            const float *x = disti_net_forward(shape, &b, store, disti_counter_of(shape->ctx, worker));
            float *seed = b.seed;
            disti_net_output(shape, &b, x, net->sdf_channel);
            for (size_t c = 0; c < count; c++)
                if (!disti_finite_all(3, job->points + 3 * (at + c))) b.value[c] = disti_nan();
            if (job->seed_fn) job->seed_fn(job->seed_user, at, count, b.value, NULL, seed);
            else memcpy(seed, job->d_sdf + at, count * sizeof(float));
            if (job->seed_fn && job->d_sdf) memcpy(job->d_sdf + at, seed, count * sizeof(float));
            for (size_t c = 0; c < DISTI_BLOCK; c++) {
                int good = c < count && disti_finite(b.value[c]) && disti_finite(seed[c]);
                seed[c] = good ? seed[c] * b.value_slope[c] : 0.0f;
            }
            disti_net_reverse(shape, &b, seed, store);
        }
    }
    size_t columns = job->directions ? (size_t)DISTI_BLOCK : count, channels = job->d_color ? 3 : 1;
    disti_weights_drop(shape, columns, channels, store);
    for (size_t i = 0; job->d_points && i < 3 * count; i++)
        if (disti_finite(b.pull[i])) job->d_points[3 * at + i] += b.pull[i];
    if (!job->d_code) return;
    disti_fold_begin(net, &b);
    disti_fold_sum(shape, &b, NULL, 0);
    disti_fold_backward(shape, &b, 0, (size_t)net->code_size, job->d_code + (size_t)index * (size_t)net->code_size);
}

enum { DISTI_WEIGHT_ROWS = 64 }; /* outputs of one task of the second phase */

/* Adds one block's share to `count` rows of layer l from `row`, the store's from `o`; but for the code's columns: total
   gets the sums of the rows' deltas. */
static void disti_weights_rows(const disti_weights_job *job, int l, size_t o, size_t row, size_t count, int index,
                               double *total)
{
    const dist_shape *shape = job->shape;
    const dist_net *net = shape->net;
    const disti_linear *layer = &net->layer[l];
    const float *store = shape->ctx->store + (size_t)index * shape->store_block_size;
    const float *xt = store + disti_store_offset(net, l, DISTI_STORE_INPUT);
    size_t values = DISTI_MIN(job->n - job->first - (size_t)index * job->block, job->block);
    float *w = job->d_weights + layer->weight + row * (size_t)layer->in, ones[16], sum[DISTI_WEIGHT_ROWS];
    const float *delta = store + disti_store_offset(net, l, DISTI_STORE_DELTA) + o * DISTI_BLOCK;
    disti_gemm_weights g = {delta, xt, w + layer->x_column, (size_t)layer->in, disti_store_stride(layer), (int)count,
                            layer->prev, job->directions ? DISTI_BLOCK : (int)values};
    shape->kernels.gemm_weights(&g);
    g.xt = xt + layer->prev;
    g.d_weights = w + layer->point_column;
    g.rows = layer->point;
    shape->kernels.gemm_weights(&g);
    for (size_t i = 0; i < 16; i++) ones[i] = 1.0f;
    memset(sum, 0, sizeof sum);
    g.xt = ones; /* for every column */
    g.xt_stride = 0;
    g.d_weights = sum;
    g.stride = 1;
    g.rows = 1;
    g.columns = (int)values; /* tangents have no share in the bias */
    shape->kernels.gemm_weights(&g);
    for (size_t i = 0; i < count; i++) {
        job->d_weights[layer->bias + row + i] += sum[i];
        total[i] += (double)sum[i];
    }
    if (!net->normed || l + 1 == net->layers) return;
    const float *sums = store + disti_store_offset(net, l, DISTI_STORE_NORM);
    for (size_t i = o; i < o + count; i++) {
        job->d_weights[layer->norm_weight + i] += sums[i];
        job->d_weights[layer->norm_bias + i] += sums[disti_store_out(layer) + i];
    }
}

static void disti_weights_task(void *arg, int index, int worker)
{
    const disti_weights_job *job = (const disti_weights_job *)arg;
    const dist_shape *shape = job->shape;
    const dist_net *net = shape->net;
    (void)worker;
    int l = 0;
    size_t o = (size_t)index * DISTI_WEIGHT_ROWS;
    for (; l + 1 < net->layers; l++) { /* tasks count off the layers' rows, each layer's rounded up to whole tasks */
        size_t rows = ((size_t)net->layer[l].out + DISTI_WEIGHT_ROWS - 1) / DISTI_WEIGHT_ROWS * DISTI_WEIGHT_ROWS;
        if (o < rows) break;
        o -= rows;
    }
    const disti_linear *layer = &net->layer[l];
    size_t out = l + 1 < net->layers ? (size_t)layer->out : job->d_color ? 3 : 1;
    size_t count = DISTI_MIN((size_t)DISTI_WEIGHT_ROWS, out - o), row = o;
    if (l + 1 == net->layers) row = (size_t)(job->d_color ? net->color_channel : net->sdf_channel); /* only theirs */
    double total[DISTI_WEIGHT_ROWS];
    memset(total, 0, sizeof total);
    for (int i = 0; i < job->blocks; i++) disti_weights_rows(job, l, o, row, count, i, total);
    for (size_t i = 0; i < count; i++) {
        float *to = job->d_weights + layer->weight + (row + i) * (size_t)layer->in + layer->code_column;
        for (size_t j = 0; j < (size_t)layer->code; j++)
            disti_add_within(&to[j], (double)layer->scale * total[i] * (double)shape->code[j]);
    }
}

/* Both phases, chunk by chunk. ctx->partial holds at least store_blocks sums of code_size if d_code is wanted. */
static void disti_weights_run(disti_weights_job *job, dist_context *ctx, double *d_code)
{
    const dist_shape *shape = job->shape;
    const dist_net *net = shape->net;
    size_t size = (size_t)net->code_size;
    int tasks = 1;
    for (int l = 0; l + 1 < net->layers; l++) tasks += (net->layer[l].out + DISTI_WEIGHT_ROWS - 1) / DISTI_WEIGHT_ROWS;
    job->block = job->directions ? DISTI_BLOCK / 2 : DISTI_BLOCK;
    job->d_code = d_code ? ctx->partial : NULL;
    if (ctx->store_user != shape) /* rows and columns that only fill up stay 0 */
        memset(ctx->store, 0, (size_t)shape->store_blocks * shape->store_block_size * sizeof(float));
    ctx->store_user = shape;
    for (; job->first < job->n; job->first += (size_t)shape->store_blocks * job->block) {
        size_t left = (job->n - job->first + job->block - 1) / job->block;
        job->blocks = left < (size_t)shape->store_blocks ? (int)left : shape->store_blocks;
        if (d_code) memset(ctx->partial, 0, (size_t)job->blocks * size * sizeof(double));
        disti_run(ctx, job->blocks, disti_weights_block, job);
        disti_run(ctx, tasks, disti_weights_task, job);
        for (size_t i = 0; d_code && i < (size_t)job->blocks; i++)
            for (size_t j = 0; j < size; j++) d_code[j] += ctx->partial[i * size + j];
    }
}

/* dist_field.weights_fn of a net. */
static dist_status disti_shape_weights_fn(void *user, dist_context *ctx, size_t n, const float *points, float *d_sdf,
                                          dist_seed_fn seed_fn, void *seed_user, float *d_points, double *d_code,
                                          float *d_weights)
{
    disti_weights_job job = {(const dist_shape *)user, n, points, NULL, NULL, d_sdf, seed_fn, seed_user, d_points, NULL,
                             d_weights, 0, 0, 0};
    disti_weights_run(&job, ctx, d_code);
    return DIST_OK;
}

/* dist_field.second_weights_fn of a net. */
static dist_status disti_shape_second_weights(void *user, dist_context *ctx, size_t n, const float *points,
                                              const float *directions, float *d_points, double *d_code,
                                              float *d_weights)
{
    disti_weights_job job = {(const dist_shape *)user, n, points, NULL, directions, NULL, NULL, NULL, d_points, NULL,
                             d_weights, 0, 0, 0};
    disti_weights_run(&job, ctx, d_code);
    return DIST_OK;
}

/* dist_field.color_weights_fn of a net. */
static void disti_shape_color_weights_fn(void *user, dist_context *ctx, size_t n, const float *points,
                                         const float *d_color, float *d_points, double *d_code, float *d_weights)
{
    disti_weights_job job = {disti_shape_paint(user), n, points, d_color, NULL, NULL, NULL, NULL, d_points, NULL,
                             d_weights, 0, 0, 0};
    disti_weights_run(&job, ctx, d_code);
}
#endif

/* Of the low-discrepancy sequence of points: powers of the plastic number of three dimensions, inverted. */
static const double DISTI_PLASTIC[3] = {0.8191725133961645, 0.6710436067037893, 0.5497004779019703};

/* Whether bounds find enough units dead: 0 no; 1 over blocks as close to each other as those of a reverse pass; 2 as a
   picture has them, too. Tried around some of B points. Beside its multiply-adds a bound is taken to cost half of them
   again, a unit's 256 more and the model of one that is alive 1800: estimates from times with AVX-512. Where bounds
   leave two thirds or less, pictures gain more than these tell (1.1: chosen by bench_step's primitives). */
static int disti_groups_pay(dist_shape *shape, const float *points)
{
    const int probes = 4;
    disti_block b;
    disti_group g;
    size_t bytes = disti_block_layout(shape->net, disti_lane(shape->ctx, 0), &b);
    disti_counter *counter = disti_counter_of(shape->ctx, 0), plain = *counter;
    double some = 0.0, more = 0.0;
    float sdf[DISTI_BLOCK];
    disti_group_layout(shape->net, disti_lane(shape->ctx, 0) + bytes, &b, &g);
    shape->groups = 0;
    for (int probe = 0; probe < probes; probe++, points += 3 * (int)DISTI_BLOCK / probes) {
        for (int i = 0; i < DISTI_BLOCK; i++) {
            for (int k = 0; k < 3; k++) {
                double u = DISTI_PLASTIC[k] * (double)(i + 1);
                g.points[3 * i + k] = points[k] + 0.12f * shape->net->bound * (float)(u - floor(u) - 0.5);
            }
        }
        disti_shape_fused(shape, 0, DISTI_BLOCK, g.points, sdf, NULL, NULL, NULL, NULL);
        some += disti_group_forward(shape, &g, DISTI_BLOCK, g.points);
        for (int l = 0; l + 1 < shape->net->layers; l++) {
            double out = shape->net->layer[l].out;
            more += out * (2.5 * g.alive_count[0][l] + 256.0) + 1800.0 * g.alive_units[0][l + 1];
        }
    }
    double all = counter->done - plain.done, share = (some + more) / all;
    shape->many = some < 2.0 / 3.0 * all;
    return (share < (shape->many ? 1.1 : 0.9)) + (share < 1.15);
}

/* How far coarse_fn is at most from sdf over a block of points; one by one where the block became f32's, as something
   in it overflows. */
static float disti_coarse_apart(const dist_field *field, const float *points, const float *sdf)
{
    float coarse[DISTI_BLOCK], most = 0.0f;
    for (size_t each = DISTI_BLOCK; each > 0 && !(most > 0.0f); each = each > 1) {
        for (size_t j = 0; j < DISTI_BLOCK; j += each)
            field->coarse_fn(field->user, 0, each, points + 3 * j, coarse + j, NULL);
        for (size_t j = 0; j < DISTI_BLOCK; j++) {
            float error = coarse[j] > sdf[j] ? coarse[j] - sdf[j] : sdf[j] - coarse[j];
            if (disti_finite(error)) most = DISTI_MAX(most, error);
        }
    }
    return most;
}

enum { DISTI_BENDS = DISTI_BLOCK / 3 };

/* |f(p) - 2 f(p + h) + f(p + 2 h)| at some of these points, each moved to a multiple of h, so that no point is rounded:
   what rounding does to f, as h is so small, 2^-20 of the radius, that f's own bends are no part of it. If the radius
   is less than 1, h is 2^-20, to 2^-10 of the radius: the net's hidden values, whose size the radius is not, would be
   the same otherwise. */
static void disti_shape_bends(const dist_field *field, const float *points, float *bends)
{
    float at[3 * DISTI_BLOCK], f[DISTI_BLOCK], power;
    uint32_t bits;
    memcpy(&bits, &field->radius, sizeof bits);
    bits &= 0x7f800000u; /* a power of 2 */
    memcpy(&power, &bits, sizeof power);
    float h = DISTI_MIN(DISTI_MAX(power, 1.0f) / 1048576.0f, power / 1024.0f);
    for (int j = 0; j < DISTI_BLOCK; j++)
        for (int k = 0; k < 3; k++)
            at[3 * j + k] = h * (floorf(points[3 * (j / 3) + k] / h) + (k == j / 3 % 3 ? (float)(j % 3) : 0.0f));
    field->eval_fn(field->user, 0, DISTI_BLOCK, at, f, NULL);
    for (int j = 0; j < DISTI_BENDS; j++)
        bends[j] = fabsf(f[3 * j] - f[3 * j + 1] - (f[3 * j + 1] - f[3 * j + 2])); /* exact: they are close */
}

/* Four times the median: more than nearly all, whatever a kink of a ReLU has put into some. */
static float disti_shape_noise(int count, float *bends)
{
    for (int i = 1; i < count; i++)
        for (int j = i; j > 0 && disti_finite(bends[j]) && !(bends[j - 1] <= bends[j]); j--) {
            float bend = bends[j];
            bends[j] = bends[j - 1];
            bends[j - 1] = bend;
        }
    return disti_finite(bends[count / 2]) ? DISTI_MIN(4.0f * bends[count / 2], 3e38f) : 0.0f;
}

/* Sampled |grad f| outside the surface: the 4/5 quantile near it, 31/32 beyond disti_far_from, at least 1. What matters
   is not the steepest spot but how far f exceeds the distance, which is its mean slope on the way; how.certified takes
   the largest all the same. Half of the 768 points are those of a fixed low-discrepancy sequence (the plastic number's)
   in the bounding sphere, half are these moved along their gradients to a place near the surface. Notes which layers
   meet no dead unit there, what 16 bits are off, and what rounding is. */
static void disti_shape_slope(dist_shape *shape, const dist_field *field)
{
    enum { ROUNDS = 16, BINS = 256 };
    int bins[2][BINS], count[2] = {0, 0};
    float most[2] = {1.0f, 1.0f};
    float points[3 * DISTI_BLOCK], sdf[DISTI_BLOCK], gradient[3 * DISTI_BLOCK], slopes[2];
    float bends[ROUNDS / 4 * DISTI_BENDS];
    float beyond = disti_far_from(field);
    const dist_net *net = shape->net;
    disti_block b;
    unsigned state = disti_float_state_enter();
    shape->all_alive = ~(uint32_t)0;
    double u[3] = {0.5, 0.5, 0.5};
    memset(bins, 0, sizeof bins);
    for (int round = 0; round < ROUNDS; round++) {
        for (int j = 0; j < DISTI_BLOCK;) {
            float *p = points + 3 * j, *g = gradient + 3 * j;
            double length = 0.0;
            for (int k = 0; k < 3; k++) {
                u[k] += DISTI_PLASTIC[k];
                if (u[k] >= 1.0) u[k] -= 1.0;
                length += (2.0 * u[k] - 1.0) * (2.0 * u[k] - 1.0);
            }
            if (round & 1) {
                float square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
                float move = square > 1e-2f ? (beyond * (float)u[0] - sdf[j]) / square : 0.0f;
                for (int k = 0; k < 3; k++) p[k] += move * g[k];
            } else {
                for (int k = 0; k < 3; k++) p[k] = field->radius * (float)(2.0 * u[k] - 1.0);
            }
            j += round & 1 || length <= 1.0;
        }
        field->eval_fn(shape, 0, DISTI_BLOCK, points, sdf, gradient);
        disti_block_layout(net, disti_lane(shape->ctx, 0), &b);
        for (int l = 1; net->activation == DIST_ACTIVATION_RELU && l < net->layers; l++)
            for (int k = 0; k < net->layer[l].prev; k++)
                if (!b.mask[(size_t)l * (size_t)net->max_rows + (size_t)k]) shape->all_alive &= ~((uint32_t)1 << l);
        for (int j = 0; j < DISTI_BLOCK; j++) {
            const float *p = points + 3 * j, *g = gradient + 3 * j;
            float slope = disti_length(g[0], g[1], g[2]);
            int bin = disti_finite(slope) && slope < 7.9f ? (int)(slope * 32.0f) : BINS - 1, far = sdf[j] > beyond;
            if (!(sdf[j] > 0.0f) || !(disti_length(p[0], p[1], p[2]) <= field->radius)) continue;
            bins[far][bin]++;
            count[far]++;
            if (disti_finite(slope)) most[far] = DISTI_MAX(most[far], slope);
        }
        if (field->coarse_fn) shape->half_error = DISTI_MAX(shape->half_error, disti_coarse_apart(field, points, sdf));
        if (round % 4 == 3) disti_shape_bends(field, points, bends + round / 4 * DISTI_BENDS);
    }
    shape->noise = disti_shape_noise((int)ROUNDS / 4 * DISTI_BENDS, bends);
    for (int far = 0; far < 2; far++) {
        int above = 0, bin = BINS - 1;
        while (bin > 0 && above + bins[far][bin] <= count[far] / (far ? 32 : 5)) above += bins[far][bin--];
        slopes[far] = count[far] > 0 ? DISTI_MAX(1.0f, (float)(bin + 1) / 32.0f) : 1.0f;
    }
    shape->lipschitz = slopes[0];
    shape->lipschitz_far = slopes[1];
    shape->certified = most[0];
    shape->certified_far = most[1];
    if (shape->groups) shape->groups = disti_groups_pay(shape, points);
    disti_float_state_leave(state);
}

static unsigned disti_shape_changes(const dist_field *field)
{
    if (field->eval_fn != disti_shape_eval_fn && field->eval_fn != field->coarse_fn) return 0;
    const dist_shape *shape = (const dist_shape *)field->user;
    const unsigned of[2] = {shape->net->changes, (unsigned)shape->net->half};
    return disti_hash(shape->changes, sizeof of, of);
}

static unsigned disti_shape_color_changes(const dist_field *field)
{
    if (field->color_fn != disti_shape_color_fn) return 0;
    const dist_shape *shape = (const dist_shape *)field->user, *paint = shape->texture ? shape->texture : shape;
    return disti_hash(paint->changes, sizeof paint->net->changes, &paint->net->changes);
}

static int disti_shape_stale(const dist_field *field, int what)
{
    int is_own = field->eval_fn == disti_shape_eval_fn || (field->coarse_fn && field->eval_fn == field->coarse_fn);
    int stale = 0;
    if ((what & DISTI_STALE_FOLD) && is_own) {
        const dist_shape *shape = (const dist_shape *)field->user;
        if (shape->folded != shape->net->changes) stale |= DISTI_STALE_FOLD;
    }
    if ((what & (DISTI_STALE_COLOR | DISTI_STALE_PAINT)) && field->color_fn == disti_shape_color_fn) {
        const dist_shape *shape = (const dist_shape *)field->user, *paint = shape->texture ? shape->texture : shape;
        if (field->taken != shape->textures) stale |= DISTI_STALE_COLOR;
        if (paint->folded != paint->net->changes) stale |= DISTI_STALE_PAINT;
    }
    return stale & what;
}

DIST_API dist_field dist_shape_field(dist_shape *shape)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    if (!shape) return field;
    const dist_net *net = shape->net;
    field.user = shape;
    field.owner = shape->ctx;
    field.changes_fn = disti_shape_changes;
    field.color_changes_fn = disti_shape_color_changes;
    field.stale_fn = disti_shape_stale;
    field.taken = shape->textures;
    if (net->sdf_channel >= 0) {
        field.eval_fn = disti_shape_eval_fn;
        field.fused_fn = disti_shape_fused;
#ifdef DISTI_HALF
        if (net->half && net->half == shape->half && shape->ctx->isa == DIST_ISA_AVX512) {
            field.coarse_fn = disti_shape_coarse;
            field.coarse_error = shape->half_error;
        }
#endif
#ifndef DIST_NO_BACKWARD
        field.second_fn = disti_shape_second;
#endif
#ifndef DIST_NO_TRAIN
        field.weights_fn = disti_shape_weights_fn;
        field.second_weights_fn = disti_shape_second_weights;
#endif
    }
    if (shape->texture || net->color_channel >= 0) {
        field.color_fn = disti_shape_color_fn;
#ifndef DIST_NO_BACKWARD
        field.color_adjoint_fn = disti_shape_color_adjoint_fn;
#endif
#ifndef DIST_NO_TRAIN
        field.color_weights_fn = disti_shape_color_weights_fn;
#endif
    }
#ifndef DIST_NO_TRAIN
    field.weight_count = net->param_count;
    field.weights_of = net;
    if (shape->texture) {
        field.color_weight_count = shape->texture->net->param_count;
        field.color_weights_of = shape->texture->net;
    }
#endif
    if (shape->texture) field.color_code_size = shape->texture->net->code_size - net->code_size;
    field.radius = net->bound;
    field.lipschitz = shape->lipschitz;
    field.lipschitz_far = shape->lipschitz_far;
    field.certified = shape->certified;
    field.certified_far = shape->certified_far;
    field.noise = shape->noise;
    field.clamp = net->clamp;
    field.cost = (float)dist_net_operations(net, 1);
    field.kinks = net->activation == DIST_ACTIVATION_RELU;
    field.many = shape->many;
    field.code_size = net->code_size;
    return field;
}

/* Folding: bias'[o] = bias[o] + scale sum_j W_code[o][j] code[j], in double; exact but for one rounding. code NULL:
   zeros. bias (layers, max_rows). */
static void disti_net_fold(const dist_net *net, const float *code, float *bias)
{
    for (int l = 0; l < net->layers; l++, bias += net->max_rows) {
        const disti_linear *layer = &net->layer[l];
        for (size_t o = 0; o < (size_t)layer->out; o++) {
            size_t unit = disti_unit(net, l, o);
            const float *w = net->params + layer->weight + unit * (size_t)layer->in + layer->code_column;
            double sum = 0.0;
            for (size_t j = 0; code && j < (size_t)layer->code; j++) sum += (double)w[j] * (double)code[j];
            bias[o] = (float)((double)net->params[layer->bias + unit] + (double)layer->scale * sum);
        }
    }
}

static void disti_shape_fold(dist_shape *shape)
{
    disti_net_fold(shape->net, shape->code, shape->bias);
    shape->changes = disti_hash(0, (size_t)shape->net->code_size * sizeof(float), shape->code);
    shape->folded = shape->net->changes;
}

/* Copies n numbers of a code, zeros for NULL; refuses what is not finite. */
static dist_status disti_code_copy(dist_context *ctx, const char *function, int color, size_t n, const float *code,
                                   float *to)
{
    for (size_t j = 0; code && j < n; j++)
        if (!disti_finite(code[j]))
            return disti_fail(ctx, DIST_NOT_FINITE, color ? "%s: color_code[%d] is %d, must be finite"
                                                          : "%s: code[%d] is %d, must be finite",
                              function, (double)j, (double)code[j]);
    if (code) memcpy(to, code, n * sizeof(float));
    else memset(to, 0, n * sizeof(float));
    return DIST_OK;
}

/* Copies the code and folds both nets with it. */
static dist_status disti_shape_set_code(dist_shape *shape, const float *code, const char *function)
{
    size_t size = (size_t)shape->net->code_size;
    dist_status status = disti_code_copy(shape->ctx, function, 0, size, code, shape->code);
    if (status != DIST_OK) return status;
    disti_shape_fold(shape);
    if (!shape->texture) return DIST_OK;
    memcpy(shape->texture->code, shape->code, size * sizeof(float));
    disti_shape_fold(shape->texture);
    return DIST_OK;
}

DIST_API dist_status dist_shape_set_code(dist_shape *shape, const float *code)
{
    return shape ? disti_shape_set_code(shape, code, "dist_shape_set_code") : DIST_BAD_ARGUMENT;
}

DIST_API dist_status dist_shape_set_color_code(dist_shape *shape, const float *color_code)
{
    const char *name = "dist_shape_set_color_code";
    if (!shape) return DIST_BAD_ARGUMENT;
    if (!shape->texture) return disti_refuse(shape->ctx, "%s: the shape has no texture", name);
    dist_shape *texture = shape->texture;
    size_t own = (size_t)shape->net->code_size, size = (size_t)texture->net->code_size;
    dist_status status = disti_code_copy(shape->ctx, name, 1, size - own, color_code, texture->code + own);
    if (status == DIST_OK) disti_shape_fold(texture);
    return status;
}

DIST_API void dist_shape_destroy(dist_shape *shape)
{
    if (!shape) return;
    dist_context *ctx = shape->ctx;
    const dist_net *net = shape->net;
    dist_shape_destroy(shape->texture);
    if (ctx->store_user == shape) ctx->store_user = NULL;
    disti_free(ctx, shape->bias, (size_t)(net->layers + 1) * (size_t)net->max_rows * sizeof(float));
    disti_free(ctx, shape->code, (size_t)net->code_size * sizeof(float));
    disti_free(ctx, shape, sizeof *shape);
}

/* The memory of a shape whose ctx and net are set, but for its own. */
static dist_status disti_shape_take(dist_shape *shape)
{
    dist_context *ctx = shape->ctx;
    const dist_net *net = shape->net;
    disti_block b;
    disti_group g;
    shape->kernels = disti_kernels_for(ctx->isa);
    shape->groups = disti_net_groups(ctx, net);
    shape->wide = dist_net_operations(net, 1) >= 100000;
    size_t bytes = disti_block_layout(net, NULL, &b);
    size_t more = shape->groups ? disti_group_layout(net, NULL, &b, &g) : disti_wide_floats(ctx, net) * sizeof(float);
    dist_status status = disti_lanes_reserve(ctx, bytes + more);
    if (status == DIST_OK) status = disti_partial_for(ctx, (size_t)net->code_size);
    if (status != DIST_OK) return status;
    shape->code = (float *)disti_alloc(ctx, (size_t)net->code_size * sizeof(float));
    shape->bias = (float *)disti_alloc(ctx, (size_t)(net->layers + 1) * (size_t)net->max_rows * sizeof(float));
    if (!shape->code || !shape->bias) return DIST_OUT_OF_MEMORY;
#ifndef DIST_NO_TRAIN
    if (net->sdf_channel >= 0 || net->color_channel >= 0) {
        size_t block = disti_store_offset(net, net->layers, DISTI_STORE_INPUT);
        size_t blocks = ((size_t)4 << 20) / (block * sizeof(float));
        shape->store_block_size = block;
        shape->store_blocks = (int)(blocks < 2 ? 2 : blocks > 32 ? 32 : blocks);
        return disti_store_reserve(ctx, (size_t)shape->store_blocks * block);
    }
#endif
    return DIST_OK;
}

DIST_API dist_shape *dist_shape_create(dist_context *ctx, const dist_net *net, const float *code)
{
    if (disti_enter(ctx, "dist_shape_create") != DIST_OK) return NULL;
    if (!net) {
        disti_refuse(ctx, "dist_shape_create: net is NULL", NULL);
        return NULL;
    }
    dist_shape *shape = (dist_shape *)disti_alloc(ctx, sizeof(dist_shape));
    if (!shape) return NULL;
    memset(shape, 0, sizeof *shape);
    shape->ctx = ctx;
    shape->net = net;
    if (disti_shape_take(shape) != DIST_OK) goto fail;
    memset(shape->bias, 0, (size_t)(net->layers + 1) * (size_t)net->max_rows * sizeof(float));
    if (disti_shape_set_code(shape, code, "dist_shape_create") != DIST_OK) goto fail;
    shape->lipschitz = shape->lipschitz_far = 1.0f;
    shape->half = net->half;
    if (net->sdf_channel >= 0) {
        dist_field field = dist_shape_field(shape);
        disti_shape_slope(shape, &field);
    }
    return shape;
fail:
    dist_shape_destroy(shape);
    return NULL;
}

static dist_status disti_texture_check(dist_context *ctx, const dist_net *net, const dist_net *texture)
{
    const char *name = "dist_shape_set_texture";
    if (texture->color_channel < 0)
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: the net has no channels r,g,b", name, 0, 0);
    if (texture->code_size < net->code_size)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: the texture's code has %d numbers, fewer than the shape's %d",
                          name, texture->code_size, net->code_size);
    return DIST_OK;
}

DIST_API dist_status dist_shape_set_texture(dist_shape *shape, const dist_net *texture, const float *color_code)
{
    const char *name = "dist_shape_set_texture";
    if (!shape) return DIST_BAD_ARGUMENT;
    dist_context *ctx = shape->ctx;
    dist_shape *paint = NULL;
    dist_status status = disti_enter(ctx, name);
    if (status == DIST_OK && texture) status = disti_texture_check(ctx, shape->net, texture);
    if (status != DIST_OK) return status;
    if (texture) {
        size_t own = (size_t)shape->net->code_size, size = (size_t)texture->code_size;
        paint = dist_shape_create(ctx, texture, NULL);
        if (!paint) return DIST_OUT_OF_MEMORY;
        memcpy(paint->code, shape->code, own * sizeof(float));
        status = disti_code_copy(ctx, name, 1, size - own, color_code, paint->code + own);
        disti_shape_fold(paint);
    }
    if (status != DIST_OK) {
        dist_shape_destroy(paint);
        return status;
    }
    dist_shape_destroy(shape->texture);
    shape->texture = paint;
    shape->textures++;
    return DIST_OK;
}

typedef struct disti_channels_job {
    const dist_shape *shape;
    disti_pieces pieces;
    const float *points;
    float *channels;
} disti_channels_job;

static void disti_channels_task(void *arg, int index, int worker)
{
    const disti_channels_job *job = (const disti_channels_job *)arg;
    size_t first, n = disti_piece(&job->pieces, index, &first);
    int channels = job->shape->net->channels;
    disti_shape_channels(job->shape, worker, n, job->points + 3 * first, 0, channels,
                         job->channels + first * (size_t)channels);
}

DIST_API dist_status dist_shape_eval(dist_context *ctx, dist_shape *shape, size_t n, const float *points,
                                     float *channels)
{
    dist_status status = disti_enter(ctx, "dist_shape_eval");
    if (status != DIST_OK) return status;
    if (!shape) return disti_refuse(ctx, "dist_shape_eval: shape is NULL", NULL);
    if (shape->ctx != ctx) return disti_refuse(ctx, "dist_shape_eval: shape belongs to another context", NULL);
    status = disti_count_check(ctx, n, "dist_shape_eval");
    if (status != DIST_OK || n == 0) return status;
    if (!points || !channels) return disti_refuse(ctx, "dist_shape_eval: %s is NULL", points ? "channels" : "points");
    if (shape->folded != shape->net->changes)
        return disti_refuse(ctx, "%s: the weights of the shape's net have changed since dist_shape_set_code; call it "
                                 "again", "dist_shape_eval");
    disti_channels_job job = {shape, disti_cut(n, 8 * DISTI_BLOCK, 1u << 20), points, channels};
    disti_run(ctx, job.pieces.count, disti_channels_task, &job);
    return DIST_OK;
}

DIST_API int dist_net_code_size(const dist_net *net) { return net ? net->code_size : 0; }
DIST_API int dist_net_code_count(const dist_net *net) { return net ? net->code_count : 0; }
DIST_API int dist_net_channels(const dist_net *net) { return net ? net->channels : 0; }
DIST_API float dist_net_bound(const dist_net *net) { return net ? net->bound : 0.0f; }
DIST_API size_t dist_net_weight_count(const dist_net *net) { return net ? net->param_count : 0; }
DIST_API const float *dist_net_weights(const dist_net *net) { return net ? net->params : NULL; }

DIST_API const float *dist_net_code(const dist_net *net, int index)
{
    return net && index >= 0 && index < net->code_count ? net->codes + (size_t)index * (size_t)net->code_size : NULL;
}

DIST_API size_t dist_net_operations(const dist_net *net, int folded)
{
    size_t sum = 0;
    for (int l = 0; net && l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        sum += (size_t)layer->out * (size_t)(layer->prev + layer->point + (folded ? 0 : layer->code));
    }
    return sum;
}

DIST_API void dist_net_destroy(dist_net *net)
{
    if (!net) return;
    dist_allocator allocator = net->allocator;
    if (net->params) allocator.free_fn(allocator.user, net->params, net->param_count * sizeof(float));
    if (net->panels) allocator.free_fn(allocator.user, net->panels, net->panel_count * sizeof(float));
    if (net->half_panels) allocator.free_fn(allocator.user, net->half_panels, net->half_count * sizeof(float));
    if (net->unit_order)
        allocator.free_fn(allocator.user, net->unit_order,
                          2 * (size_t)net->layers * (size_t)net->max_rows * sizeof(int));
    if (net->codes)
        allocator.free_fn(allocator.user, net->codes, (size_t)net->code_count * (size_t)net->code_size * sizeof(float));
    allocator.free_fn(allocator.user, net, sizeof *net);
}

static void disti_net_begin(dist_context *ctx, dist_net *net)
{
    memset(net, 0, sizeof *net);
    net->allocator = ctx->allocator;
    net->first_scale = net->scale = 1.0f;
    net->sdf_channel = net->color_channel = -1;
    net->bound = 1.0f;
}

static dist_net *disti_net_new(dist_context *ctx)
{
    dist_net *net = (dist_net *)disti_alloc(ctx, sizeof(dist_net));
    if (net) disti_net_begin(ctx, net);
    return net;
}

/* From the in and out of every layer, the sizes of input and code and the skips: what each column is, where each tensor
   stands in params and panels, and the memory for both. */
static dist_status disti_net_arrange(dist_context *ctx, dist_net *net, const int *skip, float skip_scale)
{
    int input = net->point_size + net->code_size;
    for (int l = 0; l < net->layers; l++) {
        disti_linear *layer = &net->layer[l];
        int sees_input = l == 0 || skip[l];
        layer->prev = l == 0 ? 0 : net->layer[l - 1].out;
        layer->point = sees_input ? net->point_size : 0;
        layer->code = sees_input ? net->code_size : 0;
        layer->scale = l > 0 && skip[l] ? skip_scale : 1.0f;
        const char digits[3] = {(char)('0' + (l < 10 ? l : l / 10)), (char)(l < 10 ? 0 : '0' + l % 10), 0};
        int fed = layer->prev + (sees_input ? input : 0);
        const char *wrong = "dist_net_load: layer %s is %d wide at its input, but what feeds it has %d";
        if (l > 0 && skip[l])
            wrong = "dist_net_load: layer %s, which dist.skip names, is %d wide at its input, not %d";
        else if (layer->in == fed + input)
            wrong = "dist_net_load: layer %s is %d wide at its input, but what feeds it has %d: it sees the net's "
                    "input again, too, and metadata dist.skip must name it";
        if (layer->in != fed) return disti_fail(ctx, DIST_BAD_FILE, wrong, digits, layer->in, fed);
        int at = layer->prev > 0 && !net->skip_input_first ? layer->prev : 0;
        layer->x_column = at > 0 || !sees_input ? 0 : input;
        layer->point_column = at + (net->point_first ? 0 : net->code_size);
        layer->code_column = at + (net->point_first ? net->point_size : 0);
        layer->weight = net->param_count;
        layer->bias = layer->weight + (size_t)layer->out * (size_t)layer->in;
        layer->norm_weight = layer->bias + (size_t)layer->out;
        layer->norm_bias = layer->norm_weight + (size_t)layer->out;
        int normed = net->normed && l + 1 < net->layers;
        net->param_count = normed ? layer->norm_bias + (size_t)layer->out : layer->norm_weight;
        size_t rows = (size_t)(layer->prev + layer->point), out = (size_t)layer->out;
        layer->panel = net->panel_count;
        net->panel_count += disti_round_up((l + 1 < net->layers ? disti_round_up(out, 8) : out) * rows, 16);
        net->max_rows = DISTI_MAX(net->max_rows, (int)disti_round_up(DISTI_MAX(rows, out), 8));
        net->fold_count += layer->code > 0;
    }
    net->params = (float *)disti_alloc_array(ctx, net->param_count, sizeof(float));
    net->panels = (float *)disti_alloc_array(ctx, net->panel_count, sizeof(float));
    if (net->code_count > 0)
        net->codes = (float *)disti_alloc_array(ctx, (size_t)net->code_count, (size_t)net->code_size * sizeof(float));
    return net->params && net->panels && (net->code_count == 0 || net->codes) ? DIST_OK : DIST_OUT_OF_MEMORY;
}

static size_t disti_half_steps(const disti_linear *layer, int kind)
{
    return (size_t)(kind == DIST_HALF_BF16 ? (layer->prev + 1) / 2 : layer->prev);
}

/* The largest weight that is packed. */
static float disti_half_largest(const dist_net *net)
{
    float largest = 0.0f;
    for (int l = 1; l + 1 < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        size_t rows = (size_t)(layer->prev + layer->point), count = disti_round_up((size_t)layer->out, 8) * rows;
        for (size_t i = 0; i < count; i++) {
            float w = net->panels[layer->panel + i];
            if (i / 8 % rows < (size_t)layer->prev) largest = DISTI_MAX(largest, w < 0.0f ? -w : w);
        }
    }
    return largest;
}

/* panels to half_panels, the previous units' columns: (w, w) in f16, rows 2 k and 2 k + 1 in bf16. */
static void disti_half_pack(dist_net *net)
{
    size_t offset = 0;
    for (int l = 0; l + 1 < net->layers; l++) {
        disti_linear *layer = &net->layer[l];
        size_t rows = (size_t)(layer->prev + layer->point), steps = disti_half_steps(layer, net->half);
        layer->half_panel = offset;
        offset += steps * disti_round_up((size_t)layer->out, 8);
        for (size_t o = 0; o < (size_t)layer->out; o += 8) {
            for (size_t at = 0; at < steps * 8; at++) {
                const float *w = net->panels + layer->panel + o * rows;
                uint32_t bits[2] = {0, 0};
                if (net->half == DIST_HALF_F16) {
                    bits[0] = bits[1] = disti_f16_bits(w[at]);
                } else {
                    for (size_t i = 0; i < 2 && 2 * (at / 8) + i < (size_t)layer->prev; i++) {
                        memcpy(&bits[i], w + (2 * (at / 8) + i) * 8 + at % 8, sizeof *bits);
                        bits[i] = (bits[i] + 0x7fff + (bits[i] >> 16 & 1)) >> 16;
                    }
                }
                bits[0] |= bits[1] << 16;
                memcpy(net->half_panels + layer->half_panel + o * steps + at, bits, sizeof *bits);
            }
        }
    }
}

/* params to panels: kernels' order, without the code's columns, skip_scale multiplied in. */
static void disti_net_pack(dist_net *net)
{
    memset(net->panels, 0, net->panel_count * sizeof(float));
    net->changes = disti_hash(0, net->param_count * sizeof(float), net->params);
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        size_t rows = (size_t)(layer->prev + layer->point);
        int last = l + 1 == net->layers;
        for (size_t o = 0; o < (size_t)layer->out; o++) {
            const float *w = net->params + layer->weight + disti_unit(net, l, o) * (size_t)layer->in;
            for (size_t k = 0; k < rows; k++) {
                size_t column = k < (size_t)layer->prev ? (size_t)layer->x_column + disti_unit(net, l - 1, k)
                                                        : (size_t)layer->point_column + k - (size_t)layer->prev;
                size_t at = last ? o * rows + k : (o / 8 * rows + k) * 8 + o % 8;
                net->panels[layer->panel + at] = layer->scale * w[column];
            }
        }
    }
    if (net->half == DIST_HALF_F16 && disti_half_largest(net) > 65504.0f) net->half = DIST_HALF_OFF;
    if (net->half) disti_half_pack(net);
}

/* params to panels, each layer's units in the order of how often they are alive at points of the bounding sphere, for
   up to three of the net's codes: what is left out, or put into pairs of 16 bits, then stands side by side. */
static void disti_net_sort(const dist_context *ctx, dist_net *net)
{
    enum { CODES = 3, ROUNDS = 3 };
    int units = net->unit_order ? 2 * net->layers * net->max_rows : 0;
    for (int i = 0; i < units; i++) net->unit_order[i] = i % net->max_rows;
    disti_net_pack(net);
    if (!net->unit_order) return;
    size_t width = (size_t)net->max_rows, all = (size_t)net->layers * width, at = 0;
    unsigned char *base = disti_scratch(ctx, 0) + DISTI_COUNTER_BYTES;
    float *x[2], *bias = (float *)disti_take(base, &at, all, sizeof(float));
    for (int i = 0; i < 2; i++) x[i] = (float *)disti_take(base, &at, width, DISTI_BLOCK * sizeof(float));
    uint64_t *mask = (uint64_t *)disti_take(base, &at, width, sizeof(uint64_t));
    int *count = (int *)disti_take(base, &at, all, sizeof(int)), codes = DISTI_MIN((int)CODES, net->code_count);
    disti_kernels kernels = disti_kernels_for(ctx->isa);
    unsigned state = disti_float_state_enter();
    double u[3] = {0.5, 0.5, 0.5};
    memset(count, 0, all * sizeof(int));
    for (int round = 0; round < ROUNDS * DISTI_MAX(codes, 1); round++) {
        size_t code = codes > 1 ? (size_t)(round / ROUNDS) * (size_t)(net->code_count - 1) / (size_t)(codes - 1) : 0;
        float points[3 * DISTI_BLOCK], point[3 * DISTI_BLOCK];
        if (round % ROUNDS == 0) disti_net_fold(net, codes ? net->codes + code * (size_t)net->code_size : NULL, bias);
        for (int j = 0; j < DISTI_BLOCK;) {
            double square = 0.0;
            for (int k = 0; k < 3; k++) {
                u[k] += DISTI_PLASTIC[k];
                if (u[k] >= 1.0) u[k] -= 1.0;
                points[3 * j + k] = net->bound * (float)(2.0 * u[k] - 1.0);
                square += (2.0 * u[k] - 1.0) * (2.0 * u[k] - 1.0);
            }
            j += square <= 1.0;
        }
        kernels.rows(points, point);
        for (int l = 0; l + 1 < net->layers; l++) {
            const disti_linear *layer = &net->layer[l];
            disti_gemm g = {net->panels + layer->panel, bias + (size_t)l * width, x[l & 1], x[(l + 1) & 1], NULL, mask,
                            layer->prev + layer->point, 0, layer->out, DISTI_BLOCK, 1};
            memcpy(x[l & 1] + (size_t)layer->prev * DISTI_BLOCK, point,
                   (size_t)layer->point * DISTI_BLOCK * sizeof(float));
            kernels.gemm(&g);
            for (size_t o = 0; o < (size_t)layer->out; o++)
                for (uint64_t m = mask[o]; m; m &= m - 1) count[(size_t)l * width + o]++;
        }
    }
    disti_float_state_leave(state);
    for (int l = 0; l + 1 < net->layers; l++) {
        int *order = net->unit_order + (size_t)l * width, place = 0;
        const int *alive = count + (size_t)l * width;
        for (int often = ROUNDS * CODES * DISTI_BLOCK; often >= 0; often--)
            for (int o = 0; o < net->layer[l].out; o++)
                if (alive[o] == often) order[place++] = o;
        while (place-- > 0) order[all + (size_t)order[place]] = place;
    }
    disti_net_pack(net);
}

DIST_API dist_status dist_net_set_half(dist_context *ctx, dist_net *net, int kind)
{
    const char *name = "dist_net_set_half";
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    if (!net) return disti_refuse(ctx, "%s: net is NULL", name);
    if (kind < DIST_HALF_OFF || kind > DIST_HALF_BF16)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: kind is %d, must be a DIST_HALF_ constant", name, kind, 0);
    float largest = disti_half_largest(net);
    if (kind == DIST_HALF_AUTO) kind = disti_cpu_half(DIST_HALF_F16) ? DIST_HALF_F16 : DIST_HALF_BF16;
    if (kind != DIST_HALF_OFF && !disti_cpu_half(kind))
        return disti_fail(ctx, DIST_UNSUPPORTED, "dist_net_set_half: this processor or this build has no %s arithmetic",
                          kind == DIST_HALF_F16 ? "f16" : "bf16", 0, 0);
    if (kind == DIST_HALF_F16 && largest > 65504.0f)
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: a weight is %d, beyond f16's largest number 65504", name,
                          (double)largest, 0);
    if (kind != DIST_HALF_OFF && net->normed)
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: nets with LayerNorm have no 16-bit kernel", name, 0, 0);
    float *panels = NULL;
    size_t count = 0;
    for (int l = 0; l + 1 < net->layers && kind != DIST_HALF_OFF; l++) /* at most panel_count in all: that exists */
        count += disti_half_steps(&net->layer[l], kind) * disti_round_up((size_t)net->layer[l].out, 8);
    if (count > 0) {
        panels = (float *)disti_alloc_from(ctx, &net->allocator, count * sizeof(float)); /* the net's, not ctx's */
        if (!panels) return DIST_OUT_OF_MEMORY;
    }
    dist_allocator *own = &net->allocator;
    if (net->half_panels) own->free_fn(own->user, net->half_panels, net->half_count * sizeof(float));
    net->half_panels = panels;
    net->half_count = count;
    net->half = kind;
    if (kind != DIST_HALF_OFF) disti_half_pack(net);
    return DIST_OK;
}

DIST_API int dist_net_half(const dist_net *net) { return net ? net->half : DIST_HALF_OFF; }

/* What dist_net_load carries along. */
typedef struct disti_loader {
    dist_context *ctx;
    disti_archive archive;
    const char *prefix;
    dist_net *net;
    dist_status status; /* of the first failure: after it nothing more is read */
    int skip[DISTI_MAX_LAYERS];
    float skip_scale;
} disti_loader;

/* "prefix" "stem" K "ending" into name */
static void disti_tensor_name(unsigned char *name, const char *prefix, const char *stem, int k, const char *ending)
{
    disti_writer w = {name, 0};
    disti_put_text(&w, prefix);
    disti_put_text(&w, stem);
    disti_put_size(&w, (size_t)k);
    disti_put(&w, ending, strlen(ending) + 1);
}

static const disti_tensor *disti_loader_find(const disti_loader *loader, const char *stem, int k, const char *ending)
{
    char name[96];
    disti_tensor_name((unsigned char *)name, loader->prefix, stem, k, ending);
    return disti_archive_find(&loader->archive, name);
}

/* Keeps the first failure. Returns it. */
static dist_status disti_loader_fail(disti_loader *loader, dist_status status, const char *format, const char *text,
                                     double a, double b)
{
    if (loader->status == DIST_OK) loader->status = disti_fail(loader->ctx, status, format, text, a, b);
    return loader->status;
}

/* want: what it must be. */
static dist_status disti_loader_bad(disti_loader *loader, const char *key, const char *want)
{
    const char *value = disti_archive_meta(&loader->archive, key);
    unsigned char text[320];
    disti_writer w = {text, 0};
    disti_put_text(&w, key);
    disti_put_text(&w, " is \"");
    disti_put(&w, value ? value : "", value ? DISTI_MIN(strlen(value), (size_t)80) : 0);
    disti_put_text(&w, "\", must be ");
    disti_put(&w, want, strlen(want) + 1);
    return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: metadata %s", (const char *)text, 0, 0);
}

/* kind: of number. */
static void disti_loader_beyond(disti_loader *loader, const char *key, const char *kind, double low, double high)
{
    unsigned char want[96];
    disti_writer w = {want, 0};
    disti_put_text(&w, kind);
    disti_put_number(&w, low, 6);
    disti_put_text(&w, " to ");
    disti_put_number(&w, high, 6);
    disti_put(&w, "", 1);
    disti_loader_bad(loader, key, (const char *)want);
}

/* A number at **s, or failure; advances. */
static int disti_scan_number(const char **s, double *out)
{
    return disti_parse_double(s, *s + strlen(*s), out) && disti_finite_double(*out);
}

/* As floats: what a float of 1e-6 is written as, 9.99999997e-7, is no less than 1e-6. */
static int disti_below(double value, double low)
{
    return value < low && (value < -3e38 || (float)value < (float)low);
}

/* A metadata number within [low, high]; absent: value. */
static double disti_loader_number(disti_loader *loader, const char *key, double low, double high, double value)
{
    const char *s = disti_archive_meta(&loader->archive, key);
    if (s && (!disti_scan_number(&s, &value) || *s || disti_below(value, low) || value > high))
        disti_loader_beyond(loader, key, "a number from ", low, high);
    return loader->status == DIST_OK ? value : low;
}

/* A whole one. */
static int disti_loader_whole(disti_loader *loader, const char *key, double low, double high, double value)
{
    value = disti_loader_number(loader, key, low, high, value);
    if (value != (int)value) disti_loader_beyond(loader, key, "a whole number from ", low, high);
    return (int)value;
}

/* Index of a metadata value in a |-separated list; absent or none of them: 0. */
static int disti_loader_choice(disti_loader *loader, const char *key, const char *choices)
{
    const char *value = disti_archive_meta(&loader->archive, key), *at = choices, *end = choices;
    for (int index = 0; value && end; index++) {
        if (index > 0) at = end + 1;
        end = strchr(at, '|');
        size_t length = end ? (size_t)(end - at) : strlen(at);
        if (length == strlen(value) && memcmp(at, value, length) == 0) return index;
    }
    if (value) disti_loader_bad(loader, key, choices);
    return 0;
}

static dist_status disti_loader_activation(disti_loader *loader)
{
    static const char names[6][12] = {"relu", "elu", "softplus", "sine", "tanh", "none"};
    dist_net *net = loader->net;
    const char *s = disti_archive_meta(&loader->archive, "dist.activation");
    int index = 0;
    if (!s) return DIST_OK;
    size_t n = strcspn(s, ":");
    while (index < 6 && !(strlen(names[index]) == n && memcmp(names[index], s, n) == 0)) index++;
    s += n;
    net->activation = index;
    int sine = index == DIST_ACTIVATION_SINE, scaled = sine || index == DIST_ACTIVATION_SOFTPLUS;
    double first = sine ? 30.0 : 1.0; /* SIREN's omega, PyTorch's beta */
    int good = index < 6 && (!scaled || *s != ':' || (s++, disti_scan_number(&s, &first)));
    double other = first;
    good = good && (!sine || *s != ',' || (s++, disti_scan_number(&s, &other)));
    if (!good || *s || disti_below(first, 1e-6) || first > 1e6 || disti_below(other, 1e-6) || other > 1e6)
        return disti_loader_bad(loader, "dist.activation", "relu|elu|softplus|softplus:BETA|sine|sine:OMEGA|"
                                                           "sine:FIRST,OTHERS|tanh|none, numbers from 1e-6 to 1e6");
    net->first_scale = (float)first;
    net->scale = (float)other;
    return DIST_OK;
}

static dist_status disti_loader_channels(disti_loader *loader)
{
    dist_net *net = loader->net;
    const char *s = disti_archive_meta(&loader->archive, "dist.channels");
    int twice = 0;
    if (!s) s = "sdf";
    while (net->channels < DISTI_MAX_CHANNELS) {
        s += strspn(s, " ");
        size_t whole = strcspn(s, ","), n = whole;
        while (n > 0 && s[n - 1] == ' ') n--;
        if (n == 0 || n >= sizeof net->channel_names[0]) break;
        int c = net->channels++;
        char(*names)[8] = net->channel_names;
        memcpy(names[c], s, n);
        for (int k = 0; k < c; k++) twice |= strcmp(names[k], names[c]) == 0;
        if (strcmp(names[c], "sdf") == 0) net->sdf_channel = c;
        if (c >= 2 && strcmp(names[c - 2], "r") == 0 && strcmp(names[c - 1], "g") == 0 && strcmp(names[c], "b") == 0)
            net->color_channel = c - 2;
        s += whole;
        if (!*s && !twice) return DIST_OK;
        if (!*s) break;
        s++;
    }
    return disti_loader_bad(loader, "dist.channels",
                            "1 to 16 different names of up to 7 characters, with commas between");
}

/* A misspelled key would be one that is absent. */
static dist_status disti_loader_keys(disti_loader *loader)
{
    static const char known[] =
        "|activation|output|input|skip|skip_order|skip_scale|encoding|encoding.levels|encoding.base|encoding.raw|"
        "encoding.order|norm|norm.epsilon|level|code_size|channels|bound|clamp|";
    for (size_t i = 0; i < loader->archive.meta_count; i++) {
        const char *key = loader->archive.keys[i], *at = strchr(key, '|') ? "" : known;
        size_t n = strlen(key);
        if (n < 5 || memcmp(key, "dist.", 5) != 0) continue;
        n -= 5;
        while (*at && !(memcmp(at, "|", 1) == 0 && strncmp(at + 1, key + 5, n) == 0 && at[1 + n] == '|')) at++;
        if (!*at) return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: metadata %s is not known", key, 0, 0);
    }
    return loader->status;
}

/* Everything the metadata says, but for what needs the tensors' shapes. */
static dist_status disti_loader_meta(disti_loader *loader)
{
    dist_net *net = loader->net;
    if (disti_loader_keys(loader) != DIST_OK) return loader->status;
    if (disti_loader_activation(loader) != DIST_OK || disti_loader_channels(loader) != DIST_OK) return loader->status;
    int encoding = disti_loader_choice(loader, "dist.encoding", "none|fourier");
    int levels = disti_loader_whole(loader, "dist.encoding.levels", 0, DISTI_MAX_LEVELS, 0);
    int raw = disti_loader_whole(loader, "dist.encoding.raw", 0, 1, 1);
    net->output = disti_loader_choice(loader, "dist.output", "tanh|none|sigmoid|tanh:2");
    net->point_first = disti_loader_choice(loader, "dist.input", "code,xyz|xyz,code");
    net->skip_input_first = disti_loader_choice(loader, "dist.skip_order", "x,input|input,x");
    net->levels = encoding ? levels : 0;
    net->raw = encoding ? raw : 1;
    net->order = disti_loader_choice(loader, "dist.encoding.order", "sin,cos|cos_all,sin_all|sin_all,cos_all");
    net->base = disti_loader_number(loader, "dist.encoding.base", 1e-6, 1e9, 3.14159265358979323846);
    net->normed = disti_loader_choice(loader, "dist.norm", "none|layer");
    net->norm_epsilon = (float)disti_loader_number(loader, "dist.norm.epsilon", 0, 1, 1e-5);
    net->level = (float)disti_loader_number(loader, "dist.level", -1e6, 1e6, 0);
    net->bound = (float)disti_loader_number(loader, "dist.bound", 1e-6, 1e6, 1);
    net->point_size = (net->raw ? 3 : 0) + 6 * net->levels;
    loader->skip_scale = (float)disti_loader_number(loader, "dist.skip_scale", 1e-6, 1e6, 1);
    if (loader->status == DIST_OK && encoding != (levels > 0))
        disti_loader_fail(loader, DIST_BAD_FILE,
                          encoding ? "dist_net_load: metadata dist.encoding is %s, so its levels are 1 to 16, not %d"
                                   : "dist_net_load: metadata dist.encoding.levels is %s, which only fourier has",
                          disti_archive_meta(&loader->archive, encoding ? "dist.encoding" : "dist.encoding.levels"),
                          (double)levels, 0);
    if (loader->status == DIST_OK && levels > 0 && net->base * (double)net->bound > 1e9) /* see disti_sincos */
        disti_loader_fail(loader, DIST_UNSUPPORTED,
                          "dist_net_load: metadata dist.encoding.base is %s and dist.bound %d, so angles go up to %d, "
                          "not at most 1e9", disti_archive_meta(&loader->archive, "dist.encoding.base"),
                          (double)net->bound, net->base * (double)net->bound);
    return loader->status;
}

/* The weight tensor of layer k: plain, or v of a weight-norm pair in either spelling with *gain its g. */
static const disti_tensor *disti_loader_weight(const disti_loader *loader, int k, const disti_tensor **gain)
{
    const disti_tensor *w = disti_loader_find(loader, "lin", k, ".weight");
    *gain = NULL;
    if (w) return w;
    *gain = disti_loader_find(loader, "lin", k, ".weight_g");
    if (*gain) return disti_loader_find(loader, "lin", k, ".weight_v");
    *gain = disti_loader_find(loader, "lin", k, ".parametrizations.weight.original0");
    return *gain ? disti_loader_find(loader, "lin", k, ".parametrizations.weight.original1") : NULL;
}

/* Also with module. before it. */
static const disti_tensor *disti_loader_find_codes(const disti_loader *loader)
{
    const disti_tensor *codes = disti_archive_find(&loader->archive, "codes");
    return codes || !*loader->prefix ? codes : disti_archive_find(&loader->archive, "module.codes");
}

/* LayerNorm's weight or bias behind layer k, also by the name that DeepSDF's decoder gives it. */
static const disti_tensor *disti_loader_norm(const disti_loader *loader, int k, const char *ending)
{
    const disti_tensor *norm = disti_loader_find(loader, "norm", k, ending);
    return norm ? norm : disti_loader_find(loader, "bn", k, ending);
}

/* Metadata that is silent about LayerNorm leaves it to the tensors. */
static dist_status disti_loader_norms(disti_loader *loader)
{
    int told = disti_archive_meta(&loader->archive, "dist.norm") != NULL;
    for (int k = 0; k + 1 < loader->net->layers; k++) {
        const disti_tensor *mean = disti_loader_find(loader, "bn", k, ".running_mean");
        if (mean)
            return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: tensor %s is of a batch normalization; "
                                     "fold it into the layer before it", mean->name, 0, 0);
        if (!told && disti_loader_norm(loader, k, ".weight")) loader->net->normed = 1;
    }
    return loader->status;
}

/* Where the name of a tensor goes on behind "prefix" "stem" K: *k. NULL: it is no such name, or K begins with 0. */
static const char *disti_loader_ending(const disti_loader *loader, const char *name, const char *stem, int *k)
{
    size_t prefix = strlen(loader->prefix), length = strlen(stem);
    if (strncmp(name, loader->prefix, prefix) != 0 || strncmp(name + prefix, stem, length) != 0) return NULL;
    const char *c = name + prefix + length, *digits = c;
    for (*k = 0; *c >= '0' && *c <= '9'; c++) *k = *k < 1000 ? 10 * *k + (*c - '0') : *k;
    return c == digits ? NULL : *digits == '0' && c > digits + 1 ? "" : c;
}

static const char disti_linear_endings[6][36] = {".weight",   ".bias",
                                                 ".weight_g", ".weight_v",
                                                 ".parametrizations.weight.original0",
                                                 ".parametrizations.weight.original1"};

/* Layer k has no weight: is one half of a pair there? */
static dist_status disti_loader_half(disti_loader *loader, int k)
{
    for (int j = 2; j < 6; j++) {
        const disti_tensor *half = disti_loader_find(loader, "lin", k, disti_linear_endings[j]);
        if (half)
            return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: tensor %s is one of a weight-norm pair, "
                                     ".weight_g and .weight_v or .original0 and .original1; the other is missing",
                                     half->name, 0, 0);
    }
    return DIST_OK;
}

/* What a layer has that is not understood, or twice, must not be left out without a word; nor what is behind the last
   layer, nor a normalization, unless the metadata say that there is none. */
static dist_status disti_loader_strangers(disti_loader *loader)
{
    const char(*known)[36] = disti_linear_endings;
    int told = disti_archive_meta(&loader->archive, "dist.norm") != NULL, last = loader->net->layers - 1, k;
    for (size_t i = 0; i < loader->archive.tensor_count; i++) {
        const char *name = loader->archive.tensors[i].name, *ending = disti_loader_ending(loader, name, "lin", &k);
        int found = 0;
        for (int j = 0; j < 6 && ending; j++) found |= strcmp(ending, known[j]) == 0;
        if (ending && !found)
            return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: tensor %s is of a layer, which has "
                                     ".weight, or a weight-norm pair, and .bias", name, 0, 0);
        if (ending && k > last)
            return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: tensor %s is there, but no weight of "
                                     "layer %d", name, last + 1, 0);
        ending = disti_loader_ending(loader, name, "norm", &k);
        if (!ending) ending = disti_loader_ending(loader, name, "bn", &k);
        if (!ending || (told && !loader->net->normed)) continue;
        if (k >= last || !loader->net->normed || (strcmp(ending, known[0]) != 0 && strcmp(ending, known[1]) != 0))
            return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: tensor %s is of a normalization, which "
                                     "layers but the last have, .weight and .bias", name, 0, 0);
    }
    for (k = 0; k <= last; k++) {
        if ((disti_loader_find(loader, "lin", k, known[0]) != NULL) +
                (disti_loader_find(loader, "lin", k, known[2]) != NULL) +
                (disti_loader_find(loader, "lin", k, known[4]) != NULL) > 1)
            return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: layer %d has its weights twice", NULL, k,
                                     0);
        if (loader->net->normed && disti_loader_find(loader, "norm", k, known[0]) &&
            disti_loader_find(loader, "bn", k, known[0]))
            return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: layer %d has its normalization twice", NULL,
                                     k, 0);
    }
    return loader->status;
}

/* Where the metadata name no channels the first is the distance; the others are c1, c2 and so on. */
static void disti_loader_unnamed(disti_loader *loader)
{
    dist_net *net = loader->net;
    int out = net->layer[net->layers - 1].out;
    for (; out <= DISTI_MAX_CHANNELS && net->channels < out; net->channels++)
        disti_tensor_name((unsigned char *)net->channel_names[net->channels], "", "c", net->channels, "");
}

/* layers, their in and out, the skips and the code's size, from the tensors' shapes and the metadata. */
static dist_status disti_loader_shapes(disti_loader *loader)
{
    dist_net *net = loader->net;
    const char *list = disti_archive_meta(&loader->archive, "dist.skip");
    const disti_tensor *gain;
    double at;
    loader->prefix = "";
    const disti_tensor *plain = disti_loader_weight(loader, 0, &gain);
    loader->prefix = "module.";
    const disti_tensor *wrapped = disti_loader_weight(loader, 0, &gain);
    if (plain && wrapped)
        return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: there are two networks, one with and one "
                                 "without module. before its tensors' names", NULL, 0, 0);
    if (plain) loader->prefix = "";
    if (!plain && !wrapped) {
        if (disti_loader_half(loader, 0) != DIST_OK) return loader->status;
        loader->prefix = "";
    }
    for (int k = 0; k < DISTI_MAX_LAYERS; k++) {
        const disti_tensor *w = disti_loader_weight(loader, k, &gain);
        if (!w && disti_loader_half(loader, k) != DIST_OK) return loader->status;
        if (!w) break;
        if (w->rank != 2 || w->shape[0] < 1 || w->shape[1] < 1 || w->shape[0] > DISTI_MAX_WIDTH ||
            w->shape[1] > 2 * DISTI_MAX_WIDTH)
            return disti_loader_fail(loader, DIST_BAD_FILE,
                              "dist_net_load: tensor %s must be (out, in) of 1 to %d by 1 to %d", w->name,
                              DISTI_MAX_WIDTH, 2 * DISTI_MAX_WIDTH);
        net->layer[k].out = (int)w->shape[0];
        net->layer[k].in = (int)w->shape[1];
        net->layers++;
    }
    if (net->layers == 0)
        return disti_loader_fail(loader, DIST_BAD_FILE,
            "dist_net_load: no tensor is called lin0.weight, lin0.weight_v or the like (also with module. before it)",
            NULL, 0, 0);
    for (int k = net->layers + 1; k <= DISTI_MAX_LAYERS; k++)
        if (disti_loader_weight(loader, k, &gain))
            return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: layer %d is there, but layer %d is missing",
                              NULL, k, net->layers);
    if (net->layers == DISTI_MAX_LAYERS && disti_loader_weight(loader, DISTI_MAX_LAYERS, &gain))
        return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: more than %d layers", NULL, DISTI_MAX_LAYERS,
                          0);
    if (disti_loader_norms(loader) != DIST_OK || disti_loader_strangers(loader) != DIST_OK) return loader->status;
    double size = disti_loader_number(loader, "dist.code_size", 0, DISTI_MAX_WIDTH,
                                      net->layer[0].in - net->point_size);
    if (loader->status != DIST_OK) return loader->status;
    if (size < 0)
        return disti_loader_fail(loader, DIST_BAD_FILE,
                                 "dist_net_load: lin0 takes %d numbers, fewer than the point's %d", NULL,
                                 net->layer[0].in, net->point_size);
    if (size != (int)size || size + net->point_size != net->layer[0].in)
        return disti_loader_fail(loader, DIST_BAD_FILE,
                                 "dist_net_load: layer 0 takes %d numbers, but code and point have %d", NULL,
                                 net->layer[0].in, size + net->point_size);
    net->code_size = (int)size;
    for (int l = 1; l < net->layers && !list; l++)
        loader->skip[l] = net->layer[l].in == net->layer[l - 1].out + net->layer[0].in;
    for (int entries = 1; list && *list; entries++) { /* each reads to the list's end: not more than can be */
        if (entries > DISTI_MAX_LAYERS || !disti_scan_number(&list, &at) || !(at >= 1 && at < net->layers) ||
            at != (int)at || (*list && *list != ','))
            return disti_loader_bad(loader, "dist.skip", "layers' numbers from 1 on, with commas between");
        loader->skip[(int)at] = 1;
        if (*list == ',') list++;
    }
    if (!disti_archive_meta(&loader->archive, "dist.channels")) disti_loader_unnamed(loader);
    if (net->layer[net->layers - 1].out != net->channels)
        return disti_loader_fail(loader, DIST_BAD_FILE,
                                 "dist_net_load: the last layer gives %d numbers, of at most 16, but dist.channels "
                                 "names %d", NULL, net->layer[net->layers - 1].out, net->channels);
    net->clamp = (float)disti_loader_number(loader, "dist.clamp", 0, 1e6, net->code_size > 0 ? (double)0.1f : 0.0);
    return loader->status;
}

/* Tensor, which is called stem, K, ending, -> count floats, all finite. */
static dist_status disti_loader_read(disti_loader *loader, const disti_tensor *tensor, const char *stem, int k,
                                     const char *ending, size_t count, float *out)
{
    if (loader->status != DIST_OK) return loader->status;
    if (!tensor) {
        char name[96];
        disti_tensor_name((unsigned char *)name, loader->prefix, stem, k, ending);
        return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: tensor %s is missing", name, 0, 0);
    }
    if (tensor->dtype == DISTI_DTYPE_OTHER)
        return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: tensor %s must be F32, F16 or BF16",
                          tensor->name, 0, 0);
    if (tensor->count != count)
        return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: tensor %s has %d numbers, must have %d",
                          tensor->name, (double)tensor->count, (double)count);
    disti_tensor_read(tensor, out);
    for (size_t i = 0; i < count; i++)
        if (!disti_finite(out[i]))
            return disti_loader_fail(loader, DIST_NOT_FINITE,
                              "dist_net_load: tensor %s holds %d at place %d, must be finite", tensor->name,
                              (double)out[i], (double)i);
    return DIST_OK;
}

/* Weight norm: w[o] = g[o] v[o] / |v[o]|, in double; a zero row stays zero. gain is read into the bias's place
   first. */
static void disti_weight_norm(size_t out, size_t in, const float *gain, float *v)
{
    for (size_t o = 0; o < out; o++) {
        double sum = 0.0;
        for (size_t k = 0; k < in; k++) sum += (double)v[o * in + k] * (double)v[o * in + k];
        double factor = sum > 0.0 ? (double)gain[o] / sqrt(sum) : 0.0;
        for (size_t k = 0; k < in; k++) v[o * in + k] = (float)((double)v[o * in + k] * factor);
    }
}

static dist_status disti_loader_values(disti_loader *loader)
{
    dist_net *net = loader->net;
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        const disti_tensor *gain, *weight = disti_loader_weight(loader, l, &gain);
        size_t out = (size_t)layer->out, in = (size_t)layer->in;
        float *w = net->params + layer->weight, *bias = net->params + layer->bias;
        disti_loader_read(loader, weight, "lin", l, ".weight", out * in, w);
        if (gain && gain->count == out && gain->rank > 0 && gain->shape[0] != out)
            return disti_loader_fail(loader, DIST_UNSUPPORTED, "dist_net_load: tensor %s must be (%d, 1): weight-norm "
                                     "of dimension 0", gain->name, (double)out, 0);
        if (gain && disti_loader_read(loader, gain, "lin", l, ".weight_g", out, bias) == DIST_OK)
            disti_weight_norm(out, in, bias, w);
        disti_loader_read(loader, disti_loader_find(loader, "lin", l, ".bias"), "lin", l, ".bias", out, bias);
        if (!net->normed || l + 1 == net->layers) continue;
        disti_loader_read(loader, disti_loader_norm(loader, l, ".weight"), "norm", l, ".weight", out,
                          net->params + layer->norm_weight);
        disti_loader_read(loader, disti_loader_norm(loader, l, ".bias"), "norm", l, ".bias", out,
                          net->params + layer->norm_bias);
    }
    if (net->code_count == 0) return loader->status;
    return disti_loader_read(loader, disti_loader_find_codes(loader), "codes", 0, "",
                             (size_t)net->code_count * (size_t)net->code_size, net->codes);
}

static dist_status disti_loader_codes(disti_loader *loader)
{
    const disti_tensor *codes = disti_loader_find_codes(loader);
    if (!codes || loader->net->code_size == 0) return DIST_OK;
    if (codes->rank != 2 || codes->shape[1] != (size_t)loader->net->code_size || codes->shape[0] > 0x7fffffffu)
        return disti_loader_fail(loader, DIST_BAD_FILE, "dist_net_load: tensor codes must be (n, %d)", NULL,
                                 loader->net->code_size, 0);
    loader->net->code_count = (int)codes->shape[0];
    return DIST_OK;
}

static dist_status disti_loader_open(disti_loader *loader, dist_context *ctx, const void *bytes, size_t size)
{
    memset(loader, 0, sizeof *loader);
    loader->ctx = ctx;
    if (!bytes) return disti_refuse(ctx, "dist_net_load: bytes is NULL", NULL);
    return disti_archive_open(ctx, "dist_net_load", bytes, size, &loader->archive);
}

/* From metadata and shapes all of loader->net (zeroed but for disti_net_begin) but its numbers, and their memory. */
static dist_status disti_loader_arrange(disti_loader *loader)
{
    if (disti_loader_meta(loader) != DIST_OK || disti_loader_shapes(loader) != DIST_OK ||
        disti_loader_codes(loader) != DIST_OK)
        return loader->status;
    dist_net *net = loader->net;
    dist_status status = disti_net_arrange(loader->ctx, net, loader->skip, loader->skip_scale);
    /* of smaller ones so little comes from beyond the second cache that their order hardly matters */
    int order = disti_net_sparse(net) && net->max_rows >= 384 && !loader->ctx->blas.sgemm_fn;
    if (status != DIST_OK || !order) return status;
    net->unit_order = (int *)disti_alloc_array(loader->ctx, 2 * (size_t)net->layers * (size_t)net->max_rows,
                                               sizeof(int));
    return net->unit_order ? DIST_OK : DIST_OUT_OF_MEMORY;
}

DIST_API dist_net *dist_net_load(dist_context *ctx, const void *bytes, size_t size)
{
    disti_loader loader;
    if (disti_enter(ctx, "dist_net_load") != DIST_OK) return NULL;
    if (disti_loader_open(&loader, ctx, bytes, size) != DIST_OK) return NULL;
    loader.net = disti_net_new(ctx);
    int good = loader.net && disti_loader_arrange(&loader) == DIST_OK && disti_loader_values(&loader) == DIST_OK;
    if (good) disti_net_sort(ctx, loader.net);
    disti_archive_close(ctx, &loader.archive);
    if (good) return loader.net;
    dist_net_destroy(loader.net);
    return NULL;
}

/* Text of the metadata being written, one value after another. */
typedef struct disti_saver {
    const char *keys[24], *values[24];
    size_t count;
    disti_writer w;
    unsigned char text[1024];
} disti_saver;

static void disti_saver_text(disti_saver *s, const char *key, const char *value)
{
    s->keys[s->count] = key;
    s->values[s->count++] = value;
}

/* The text since `at`, ended. */
static const char *disti_saver_end(disti_saver *s, size_t at)
{
    disti_put(&s->w, "", 1);
    return (const char *)s->text + at;
}

/* key: before a, and b with a comma unless it is the same number */
static void disti_saver_number(disti_saver *s, const char *key, const char *before, double a, double b, int digits)
{
    size_t at = s->w.size;
    disti_put_text(&s->w, before);
    disti_put_number(&s->w, a, digits);
    if (a != b) disti_put_text(&s->w, ",");
    if (a != b) disti_put_number(&s->w, b, digits);
    disti_saver_text(s, key, disti_saver_end(s, at));
}

/* key: x > 0, in as many digits as are read as x again: 15, else 17, the last ones by trial. */
static void disti_saver_exactly(disti_saver *s, const char *key, double x)
{
    size_t at = s->w.size;
    char text[32];
    int exponent;
    uint64_t mantissa = disti_decimal_digits(x, 17, &exponent);
    for (uint64_t k = 0, found = 0; k < 129 && !found; k++) { /* then mantissa, + 1, - 1, + 2 ... */
        double back = 0.0;
        uint64_t digits = k & 1 ? mantissa - k / 2 : mantissa + k / 2;
        const char *end = text;
        text[k == 0 ? disti_format_number(text, x, 15) : disti_format_digits(text, digits, 17, exponent)] = 0;
        found = disti_scan_number(&end, &back) && back == x;
    }
    disti_put_text(&s->w, text);
    disti_saver_text(s, key, disti_saver_end(s, at));
}

static void disti_saver_meta(disti_saver *s, const dist_net *net)
{
    static const char activations[6][12] = {"relu", "elu", "softplus:", "sine:", "tanh", "none"};
    static const char outputs[4][8] = {"tanh", "none", "sigmoid", "tanh:2"};
    static const char orders[3][16] = {"sin,cos", "cos_all,sin_all", "sin_all,cos_all"};
    float skip_scale = 1.0f;
    memset(s, 0, sizeof *s);
    s->w.out = s->text;
    for (int l = 1; l < net->layers; l++) {
        if (!net->layer[l].point) continue;
        if (s->w.size) disti_put_text(&s->w, ",");
        disti_put_size(&s->w, (size_t)l);
        skip_scale = net->layer[l].scale;
    }
    const char *skip = disti_saver_end(s, 0);
    size_t at = s->w.size;
    for (int c = 0; c < net->channels; c++) {
        if (c) disti_put_text(&s->w, ",");
        disti_put_text(&s->w, net->channel_names[c]);
    }
    const char *channels = disti_saver_end(s, at);
    disti_saver_text(s, "format", "dist-net-1");
    if (net->activation == DIST_ACTIVATION_SOFTPLUS || net->activation == DIST_ACTIVATION_SINE)
        disti_saver_number(s, "dist.activation", activations[net->activation], (double)net->first_scale,
                           (double)net->scale, 9);
    else
        disti_saver_text(s, "dist.activation", activations[net->activation]);
    disti_saver_text(s, "dist.output", outputs[net->output]);
    disti_saver_text(s, "dist.input", net->point_first ? "xyz,code" : "code,xyz");
    disti_saver_text(s, "dist.skip", skip);
    disti_saver_text(s, "dist.skip_order", net->skip_input_first ? "input,x" : "x,input");
    disti_saver_number(s, "dist.skip_scale", "", (double)skip_scale, (double)skip_scale, 9);
    disti_saver_text(s, "dist.encoding", net->levels ? "fourier" : "none");
    if (net->levels) {
        disti_saver_number(s, "dist.encoding.levels", "", net->levels, net->levels, 6);
        disti_saver_exactly(s, "dist.encoding.base", net->base);
        disti_saver_text(s, "dist.encoding.raw", net->raw ? "1" : "0");
        disti_saver_text(s, "dist.encoding.order", orders[net->order]);
    }
    disti_saver_text(s, "dist.norm", net->normed ? "layer" : "none");
    if (net->normed)
        disti_saver_number(s, "dist.norm.epsilon", "", (double)net->norm_epsilon, (double)net->norm_epsilon, 9);
    disti_saver_number(s, "dist.level", "", (double)net->level, (double)net->level, 9);
    disti_saver_number(s, "dist.code_size", "", net->code_size, net->code_size, 6);
    disti_saver_text(s, "dist.channels", channels);
    disti_saver_number(s, "dist.bound", "", (double)net->bound, (double)net->bound, 9);
    disti_saver_number(s, "dist.clamp", "", (double)net->clamp, (double)net->clamp, 9);
}

DIST_API dist_status dist_net_save(dist_context *ctx, const dist_net *net, void *buffer, size_t capacity, size_t *size)
{
    enum { MOST = 4 * DISTI_MAX_LAYERS + 1 };
    disti_tensor_out tensors[MOST];
    unsigned char names[MOST][16];
    disti_saver saver;
    size_t count = 0;
    dist_status status = disti_enter(ctx, "dist_net_save");
    if (status != DIST_OK) return status;
    if (!net || !size) return disti_refuse(ctx, "dist_net_save: %s is NULL", net ? "size" : "net");
    memset(tensors, 0, sizeof tensors);
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        size_t offsets[4] = {layer->weight, layer->bias, layer->norm_weight, layer->norm_bias};
        for (int i = 0; i < (net->normed && l + 1 < net->layers ? 4 : 2); i++) {
            disti_tensor_name(names[count], "", i < 2 ? "lin" : "norm", l, i % 2 ? ".bias" : ".weight");
            tensors[count].name = (const char *)names[count];
            tensors[count].rank = i == 0 ? 2 : 1;
            tensors[count].shape[0] = (size_t)layer->out;
            tensors[count].shape[1] = (size_t)layer->in;
            tensors[count++].data = net->params + offsets[i];
        }
    }
    if (net->code_count > 0) {
        tensors[count].name = "codes";
        tensors[count].rank = 2;
        tensors[count].shape[0] = (size_t)net->code_count;
        tensors[count].shape[1] = (size_t)net->code_size;
        tensors[count++].data = net->codes;
    }
    disti_saver_meta(&saver, net);
    return disti_archive_write(ctx, "dist_net_save", count, tensors, saver.count, saver.keys, saver.values, buffer,
                               capacity, size);
}

#ifndef DIST_NO_STDIO
/* Reads a whole file into memory of the context; *size bytes, to be given back with disti_free. */
static unsigned char *disti_file_read(dist_context *ctx, const char *function, const char *path, size_t *size)
{
    *size = 0;
    ctx->path = path;
    FILE *file = path ? fopen(path, "rb") : NULL;
    long end = file && fseek(file, 0, SEEK_END) == 0 ? ftell(file) : -1;
    int good = end >= 0 && end <= 0x7ffffff0L && fseek(file, 0, SEEK_SET) == 0;
    unsigned char *bytes = good ? (unsigned char *)disti_alloc(ctx, (size_t)end) : NULL;
    size_t got = bytes ? fread(bytes, 1, (size_t)end, file) : 0;
    if (!path) disti_refuse(ctx, "%s: path is NULL", function);
    else if (!file) disti_fail(ctx, DIST_IO, "%s: the file cannot be opened", function, 0, 0);
    else if (!good) disti_fail(ctx, DIST_IO, "%s: not a file that can be read whole", function, 0, 0);
    else if (bytes && got != (size_t)end)
        disti_fail(ctx, DIST_IO, "%s: reading failed after %d of %d bytes", function, (double)got, (double)end);
    ctx->path = NULL;
    if (file) fclose(file);
    if (bytes && got == (size_t)end) *size = got;
    else if (bytes) disti_free(ctx, bytes, (size_t)end);
    return bytes && got == (size_t)end ? bytes : NULL;
}

/* Writes and gives back bytes, which disti_alloc returned, unless status says that they were not made. */
static dist_status disti_file_write(dist_context *ctx, const char *function, const char *path, void *bytes,
                                    size_t size, dist_status status)
{
    if (!bytes) return DIST_OUT_OF_MEMORY;
    ctx->path = path;
    if (status == DIST_OK) {
        FILE *file = path ? fopen(path, "wb") : NULL;
        size_t put = file ? fwrite(bytes, 1, size, file) : 0;
        int closed = file ? fclose(file) : 0;
        if (!path) status = disti_refuse(ctx, "%s: path is NULL", function);
        else if (!file) status = disti_fail(ctx, DIST_IO, "%s: the file cannot be opened for writing", function, 0, 0);
        else if (put != size || closed != 0)
            status = disti_fail(ctx, DIST_IO, "%s: writing failed after %d of %d bytes", function, (double)put,
                                (double)size);
    }
    ctx->path = NULL;
    disti_free(ctx, bytes, size);
    return status;
}

DIST_API dist_net *dist_net_load_file(dist_context *ctx, const char *path)
{
    size_t size;
    if (disti_enter(ctx, "dist_net_load_file") != DIST_OK) return NULL;
    unsigned char *bytes = disti_file_read(ctx, "dist_net_load_file", path, &size);
    ctx->path = path;
    dist_net *net = bytes ? dist_net_load(ctx, bytes, size) : NULL;
    ctx->path = NULL;
    disti_free(ctx, bytes, size);
    return net;
}

DIST_API dist_status dist_net_save_file(dist_context *ctx, const dist_net *net, const char *path)
{
    size_t size;
    dist_status status = dist_net_save(ctx, net, NULL, 0, &size);
    if (status != DIST_OK) return status;
    ctx->function = "dist_net_save_file";
    void *bytes = disti_alloc(ctx, size);
    if (bytes) status = dist_net_save(ctx, net, bytes, size, &size);
    return disti_file_write(ctx, "dist_net_save_file", path, bytes, size, status);
}
#endif

#ifndef DIST_NO_TRAIN
/* By Box and Muller. */
static double disti_normal(uint64_t *state)
{
    double u = disti_random_unit(state), v = disti_random_unit(state);
    double s, c;
    disti_sincos(6.28318530717958647692 * v, &s, &c);
    return sqrt(-2.0 * log(1.0 - u)) * c;
}

/* A geometric start's points: on a sphere, evenly. */
enum { DISTI_START_POINTS = 16 };

/* The last biases, so that the mean of f before its end is 0 over points at half the bound. -radius would do for ReLU
   in wide layers alone: softplus is log(2) / beta at 0, and 8 layers of 512 units with beta 100 add that up to
   f(0) = 0. */
static dist_status disti_net_center(dist_context *ctx, dist_net *net)
{
    enum { N = DISTI_START_POINTS };
    const double count = N;
    float *x = (float *)disti_alloc_array(ctx, 2 * (size_t)net->max_rows, N * sizeof(float));
    if (!x) return DIST_OUT_OF_MEMORY;
    float *in = x, *out = x + (size_t)net->max_rows * N;
    memset(in, 0, (size_t)net->max_rows * N * sizeof(float));
    for (int i = 0; i < N; i++) {
        double s, c, z = 1.0 - (2.0 * i + 1.0) / count, r = 0.5 * (double)net->bound;
        disti_sincos(2.39996322972865332 * i, &s, &c); /* the golden angle */
        in[i] = (float)(r * sqrt(1.0 - z * z) * c);
        in[N + i] = (float)(r * sqrt(1.0 - z * z) * s);
        in[2 * N + i] = (float)(r * z);
    }
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        int rows = l == 0 ? 3 : layer->prev, first = l == 0 ? layer->point_column : layer->x_column;
        for (int o = 0; o < layer->out; o++) {
            const float *w = net->params + layer->weight + (size_t)o * (size_t)layer->in + (size_t)first;
            float sum[N] = {0};
            double mean = 0.0;
            for (int k = 0; k < rows; k++)
                for (int i = 0; i < N; i++) sum[i] += w[k] * in[k * N + i];
            for (int i = 0; i < N; i++) mean += (double)sum[i] / count;
            if (l + 1 == net->layers) net->params[layer->bias + (size_t)o] = (float)-mean;
            else memcpy(out + (size_t)o * N, sum, sizeof sum);
        }
        if (l + 1 == net->layers) break;
        disti_activate(net->activation, l == 0 ? net->first_scale : net->scale, (size_t)layer->out * N, out, NULL);
        float *t = in;
        in = out;
        out = t;
    }
    disti_free(ctx, x, 2 * (size_t)net->max_rows * N * sizeof(float));
    return DIST_OK;
}

/* PyTorch's start: uniform within 1 / sqrt(in). SIREN's: within 1 / in at first, sqrt(6 / in) / omega then.
   Geometric (Atzmon and Lipman 2020): normal, sigma sqrt(2 / out), the last layer's mean sqrt(pi / in), biases 0;
   columns of the code, of Fourier levels and skipped-in ones 0, so that f starts near |p| + bias. */
static dist_status disti_net_randomize(dist_context *ctx, dist_net *net, const dist_net_desc *desc)
{
    uint64_t state = desc->seed;
    state = disti_random_bits(&state); /* else a seed's numbers are its neighbor's, some draws later */
    for (int l = 0; l < net->layers; l++) {
        const disti_linear *layer = &net->layer[l];
        int last = l + 1 == net->layers, sine = net->activation == DIST_ACTIVATION_SINE;
        double in = layer->in;
        double range = sine ? (l == 0 ? 1.0 / in : sqrt(6.0 / in) / (double)net->scale) : 1.0 / sqrt(in);
        for (int o = 0; o < layer->out; o++) {
            float *w = net->params + layer->weight + (size_t)o * (size_t)layer->in;
            for (int k = 0; k < layer->in; k++) {
                int is_code = k >= layer->code_column && k < layer->code_column + layer->code;
                int is_point = k >= layer->point_column && k < layer->point_column + layer->point;
                int is_level = is_point && k >= layer->point_column + 3;
                double x = (2.0 * disti_random_unit(&state) - 1.0) * range;
                if (desc->geometric) {
                    x = last ? sqrt(3.14159265358979 / in) + 1e-4 * disti_normal(&state)
                             : disti_normal(&state) * sqrt(2.0 / layer->out);
                    if (is_code || is_level || (l > 0 && is_point)) x = 0.0;
                }
                w[k] = (float)x;
            }
            double b = (2.0 * disti_random_unit(&state) - 1.0) * range;
            net->params[layer->bias + (size_t)o] = desc->geometric ? 0.0f : (float)b;
        }
    }
    return desc->geometric ? disti_net_center(ctx, net) : DIST_OK;
}

static dist_status disti_net_desc_check(dist_context *ctx, const dist_net_desc *d)
{
    const char *name = "dist_net_create";
    const disti_limit limits[] = {
        {"layers", (double)d->layers, 1, DISTI_MAX_LAYERS - 1}, {"width", (double)d->width, 1, 4096},
        {"skip", (double)d->skip, 0, (double)d->layers - 1.0}, {"levels", (double)d->levels, 0, DISTI_MAX_LEVELS},
        {"code_size", (double)d->code_size, 0, 4096}, {"code_count", (double)d->code_count, 0, 1e7},
        {"activation", (double)d->activation, 0, DIST_ACTIVATION_NONE},
        {"output_linear", (double)d->output_linear, 0, 1}, {"color", (double)d->color, 0, 1},
        {"geometric", (double)d->geometric, 0, 1}};
    dist_status status = disti_limits(ctx, name, sizeof limits / sizeof limits[0], limits);
    if (status != DIST_OK) return status;
    const float value[3] = {d->scale, d->bound, d->clamp};
    for (int i = 0; i < 3; i++) /* what a file may say */
        if (!disti_finite(value[i]) || (i < 2 && value[i] < 1e-6f) || value[i] > 1e6f)
            return disti_fail(ctx, DIST_BAD_ARGUMENT,
                              i == 0   ? "dist_net_create: scale is %d, must be 1e-6 to 1e6, or 0"
                              : i == 1 ? "dist_net_create: bound is %d, must be 1e-6 to 1e6, or 0"
                                       : "dist_net_create: clamp is %d, must be at most 1e6",
                              NULL, (double)value[i], 0);
    if (d->geometric && d->activation != DIST_ACTIVATION_RELU && d->activation != DIST_ACTIVATION_SOFTPLUS)
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "dist_net_create: geometric is 1 with activation %d, must be 0: there is none but for ReLU "
                          "and softplus", NULL, (double)d->activation, 0);
    return DIST_OK;
}

DIST_API dist_net_desc dist_net_desc_resolve(const dist_net_desc *desc)
{
    dist_net_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.layers == 0) d.layers = 8;
    if (d.width == 0) d.width = 512;
    if (d.scale == 0.0f) d.scale = d.activation == DIST_ACTIVATION_SINE ? 30.0f : 100.0f;
    if (d.bound == 0.0f) d.bound = 1.0f;
    if (d.clamp == 0.0f && d.code_size > 0 && !d.color) d.clamp = 0.1f;
    return d;
}

DIST_API dist_net *dist_net_create(dist_context *ctx, const dist_net_desc *desc)
{
    int skip[DISTI_MAX_LAYERS];
    if (disti_enter(ctx, "dist_net_create") != DIST_OK) return NULL;
    dist_net_desc d = dist_net_desc_resolve(desc);
    if (disti_net_desc_check(ctx, &d) != DIST_OK) return NULL;
    dist_net *net = disti_net_new(ctx);
    if (!net) return NULL;
    memset(skip, 0, sizeof skip);
    skip[d.skip] = d.skip > 0;
    net->layers = d.layers + 1;
    net->channels = d.color ? 3 : 1;
    if (d.color) net->color_channel = 0;
    else net->sdf_channel = 0;
    memcpy(net->channel_names[0], d.color ? "r" : "sdf", d.color ? 2 : 4);
    memcpy(net->channel_names[1], "g", 2);
    memcpy(net->channel_names[2], "b", 2);
    net->raw = 1;
    net->levels = d.levels;
    net->base = 3.14159265358979323846;
    net->point_size = 3 + 6 * d.levels;
    net->code_size = d.code_size;
    net->code_count = d.code_size > 0 ? d.code_count : 0;
    net->activation = d.activation;
    if (d.activation == DIST_ACTIVATION_SOFTPLUS || d.activation == DIST_ACTIVATION_SINE)
        net->first_scale = net->scale = d.scale;
    net->output = d.output_linear ? DISTI_OUTPUT_NONE : d.color ? DISTI_OUTPUT_SIGMOID : DISTI_OUTPUT_TANH;
    net->bound = d.bound;
    net->clamp = DISTI_MAX(d.clamp, 0.0f);
    net->norm_epsilon = 1e-5f;
    for (int l = 0; l < net->layers; l++) {
        net->layer[l].out = l + 1 == net->layers ? net->channels : d.width;
        net->layer[l].in = (l > 0 ? d.width : 0) + (l == 0 || skip[l] ? net->point_size + d.code_size : 0);
    }
    if (disti_net_arrange(ctx, net, skip, 1.0f) != DIST_OK || disti_net_randomize(ctx, net, &d) != DIST_OK) {
        dist_net_destroy(net);
        return NULL;
    }
    if (net->codes) memset(net->codes, 0, (size_t)net->code_count * (size_t)net->code_size * sizeof(float));
    disti_net_pack(net);
    return net;
}

DIST_API dist_status dist_net_set_weights(dist_context *ctx, dist_net *net, const float *weights)
{
    dist_status status = disti_enter(ctx, "dist_net_set_weights");
    if (status != DIST_OK) return status;
    if (!net || !weights) return disti_refuse(ctx, "dist_net_set_weights: %s is NULL", net ? "weights" : "net");
    for (size_t i = 0; i < net->param_count; i++)
        if (!disti_finite(weights[i]))
            return disti_fail(ctx, DIST_NOT_FINITE, "dist_net_set_weights: weights[%d] is %d, must be finite", NULL,
                              (double)i, (double)weights[i]);
    memcpy(net->params, weights, net->param_count * sizeof(float));
    disti_net_pack(net);
    return DIST_OK;
}

DIST_API dist_status dist_net_set_code(dist_context *ctx, dist_net *net, int index, const float *code)
{
    dist_status status = disti_enter(ctx, "dist_net_set_code");
    if (status != DIST_OK) return status;
    if (!net || !code) return disti_refuse(ctx, "dist_net_set_code: %s is NULL", net ? "code" : "net");
    if (net->code_count == 0) return disti_refuse(ctx, "dist_net_set_code: the net stores no codes", NULL);
    if (index < 0 || index >= net->code_count)
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "dist_net_set_code: index is %d, must be 0 to %d", NULL, index, net->code_count - 1);
    size_t size = (size_t)net->code_size;
    return disti_code_copy(ctx, "dist_net_set_code", 0, size, code, net->codes + (size_t)index * size);
}
#endif

/*@ 06 camera ------------------------------------------------------------------------------------------------------- */

/* What the tracer and the adjoint use of a camera, in double. */
typedef struct disti_view {
    double rotation[9], translation[3], center[3]; /* center = -R^T t */
    double fx, fy, cx, cy, skew, first;
    int width, height;
} disti_view;

static void disti_view_of(const dist_camera *camera, disti_view *view)
{
    double minus[3];
    for (int i = 0; i < 9; i++) view->rotation[i] = (double)camera->rotation[i];
    disti_orthonormalize(view->rotation); /* float rounding alone would move a far camera's center */
    for (int i = 0; i < 3; i++) view->translation[i] = (double)camera->translation[i];
    for (int i = 0; i < 3; i++) minus[i] = -view->translation[i];
    disti_rotate_back(view->rotation, minus, view->center);
    view->fx = (double)camera->fx;
    view->fy = (double)camera->fy;
    view->cx = (double)camera->cx;
    view->cy = (double)camera->cy;
    view->skew = (double)camera->skew;
    view->first = (double)camera->pixel_center;
    view->width = camera->width;
    view->height = camera->height;
}

/* Unit direction in camera space of the pixel with index (x, y): normalize(K^-1 (u, v, 1)), u = x + pixel_center. */
static void disti_view_direction(const disti_view *view, double x, double y, double direction[3])
{
    direction[1] = (y + view->first - view->cy) / view->fy;
    direction[0] = (x + view->first - view->cx - view->skew * direction[1]) / view->fx;
    direction[2] = 1.0;
    disti_normalize(direction);
}

static dist_status disti_camera_check(dist_context *ctx, const dist_camera *camera, const char *function)
{
    if (!camera) return disti_refuse(ctx, "%s: camera is NULL", function);
    if (camera->width < 1 || camera->width > 65536 || camera->height < 1 || camera->height > 65536)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: camera is %d x %d pixels, each side must be 1 to 65536",
                          function, camera->width, camera->height);
    if (!disti_finite(camera->fx) || !disti_finite(camera->fy) || !(fabsf(camera->fx) > 1e-22f) ||
        !(fabsf(camera->fy) > 1e-22f)) /* their squares are to be above 0 */
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: camera.fx is %d, fy %d; must be finite and not 0 (1e-22 at "
                                                  "least); dist_camera_look_at takes fov_y in radians, below pi",
                          function, (double)camera->fx, (double)camera->fy);
    const float other[4] = {camera->cx, camera->cy, camera->skew, camera->pixel_center};
    static const char named[4][46] = {"%s: camera.cx is %d, must be finite", "%s: camera.cy is %d, must be finite",
                                      "%s: camera.skew is %d, must be finite",
                                      "%s: camera.pixel_center is %d, must be finite"};
    for (int i = 0; i < 4; i++)
        if (!disti_finite(other[i]))
            return disti_fail(ctx, DIST_NOT_FINITE, named[i], function, (double)other[i], 0);
    for (int i = 0; i < 12; i++) {
        float x = i < 9 ? camera->rotation[i] : camera->translation[i - 9];
        if (disti_finite(x)) continue;
        return disti_fail(ctx, DIST_NOT_FINITE, i < 9 ? "%s: camera.rotation[%d] is %d, must be finite"
                                                      : "%s: camera.translation[%d] is %d, must be finite",
                          function, i < 9 ? i : i - 9, (double)x);
    }
    double m[9];
    for (int i = 0; i < 9; i++) m[i] = (double)camera->rotation[i];
    return disti_rotation_check(ctx, m, "%s: camera.rotation is not a rotation (rows off orthonormal by %d, "
                                        "determinant %d); see dist_camera_move", function);
}

/* rows of camera->rotation: right, down, forward */
static void disti_camera_place(dist_camera *camera, const double m[9], const double center[3])
{
    double t[3];
    disti_rotate(m, center, t);
    for (int i = 0; i < 9; i++) camera->rotation[i] = (float)m[i];
    for (int i = 0; i < 3; i++) camera->translation[i] = (float)-t[i];
}

DIST_API dist_camera dist_camera_look_at(int width, int height, float fov_y, const float eye[3], const float at[3],
                                         const float up[3])
{
    dist_camera camera;
    double m[9], center[3], down[3] = {0.0, -1.0, 0.0}, focal = 0.0;
    int good = (!eye || disti_finite_all(3, eye)) && (!at || disti_finite_all(3, at));
    good = good && (!up || disti_finite_all(3, up));
    memset(&camera, 0, sizeof camera);
    camera.width = width;
    camera.height = height;
    if (!good) eye = at = up = NULL;
    if (good && disti_between(fov_y, 0.0f, 3.14159265f)) focal = height / 2.0 / tan((double)fov_y / 2.0);
    if (fabs(focal) < 3.4e38) camera.fx = camera.fy = (float)focal; /* else 0: refused by whoever takes the camera */
    camera.cx = (float)((width - 1.0) / 2.0);
    camera.cy = (float)((height - 1.0) / 2.0);
    for (int i = 0; i < 3; i++) {
        center[i] = eye ? (double)eye[i] : 0.0;
        m[6 + i] = (at ? (double)at[i] : 0.0) - center[i];
        if (up) down[i] = -(double)up[i];
    }
    if (!disti_normalize(m + 6)) m[6] = 0.0, m[7] = 0.0, m[8] = 1.0;
    disti_cross(down, m + 6, m); /* right = down x forward */
    double size = sqrt(disti_dot(down, down));
    if (!(sqrt(disti_dot(m, m)) > 1e-6 * size) || !disti_normalize(m)) {
        int least = fabs(m[6]) < fabs(m[7]) ? (fabs(m[6]) < fabs(m[8]) ? 0 : 2) : (fabs(m[7]) < fabs(m[8]) ? 1 : 2);
        for (int i = 0; i < 3; i++) down[i] = i == least ? -1.0 : 0.0;
        disti_cross(down, m + 6, m);
        disti_normalize(m);
    }
    disti_cross(m + 6, m, m + 3);
    disti_camera_place(&camera, m, center);
    return camera;
}

/* OpenGL's camera axes are ours with y and z turned over: R = (diag(1, -1, -1)) (rotation of camera_to_world)^T. */
DIST_API void dist_camera_set_opengl(dist_camera *camera, const float camera_to_world[12])
{
    double m[9], center[3], determinant;
    if (!camera || !camera_to_world) return;
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) m[3 * i + j] = (double)camera_to_world[4 * j + i] * (i == 0 ? 1.0 : -1.0);
        center[i] = (double)camera_to_world[4 * i + 3];
    }
    if (disti_finite_all(12, camera_to_world) && disti_rotation_off(m, &determinant) <= 1e-3 && determinant > 0.0)
        disti_orthonormalize(m); /* as every reader will: so the place stays */
    disti_camera_place(camera, m, center);
}

DIST_API void dist_camera_get_opengl(const dist_camera *camera, float camera_to_world[12])
{
    disti_view view;
    if (!camera || !camera_to_world) return;
    disti_view_of(camera, &view);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            camera_to_world[4 * j + i] = (float)(view.rotation[3 * i + j] * (i == 0 ? 1.0 : -1.0));
        camera_to_world[4 * i + 3] = (float)view.center[i];
    }
}

DIST_API dist_status dist_camera_set_colmap(dist_camera *camera, const float quaternion[4], const float translation[3])
{
    if (!camera || !quaternion || !translation) return DIST_BAD_ARGUMENT;
    if (!disti_finite_all(4, quaternion) || !disti_finite_all(3, translation)) return DIST_NOT_FINITE;
    double q[4], length = 0.0;
    for (int i = 0; i < 4; i++) length += (double)quaternion[i] * (double)quaternion[i];
    if (!(length > 0.0)) return DIST_BAD_ARGUMENT;
    for (int i = 0; i < 4; i++) q[i] = (double)quaternion[i] / sqrt(length);
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double m[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                   2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                   2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    for (int i = 0; i < 9; i++) camera->rotation[i] = (float)m[i];
    memcpy(camera->translation, translation, sizeof camera->translation);
    camera->pixel_center = 0.5f;
    return DIST_OK;
}

/* Shepperd's way: the largest of the four squares is divided by. */
DIST_API void dist_camera_get_colmap(const dist_camera *camera, float quaternion[4], float translation[3])
{
    if (!camera || !quaternion || !translation) return;
    const float *m = camera->rotation;
    double trace = (double)m[0] + (double)m[4] + (double)m[8];
    double s[4] = {trace, (double)m[0], (double)m[4], (double)m[8]}, q[4];
    int best = 0;
    for (int i = 1; i < 4; i++) best = s[i] > s[best] ? i : best;
    double off[3] = {(double)m[7] - (double)m[5], (double)m[2] - (double)m[6], (double)m[3] - (double)m[1]};
    if (best == 0) {
        q[0] = 1.0 + trace;
        for (int i = 0; i < 3; i++) q[1 + i] = off[i];
    } else {
        int i = best - 1, j = (i + 1) % 3, k = (i + 2) % 3;
        q[1 + i] = 1.0 + 2.0 * s[best] - trace;
        q[1 + j] = (double)m[3 * i + j] + (double)m[3 * j + i];
        q[1 + k] = (double)m[3 * i + k] + (double)m[3 * k + i];
        q[0] = off[i];
    }
    double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]) * (q[0] < 0.0 ? -1.0 : 1.0);
    for (int i = 0; i < 4; i++) quaternion[i] = (float)(q[i] / length);
    memcpy(translation, camera->translation, sizeof camera->translation);
}

DIST_API void dist_camera_move(dist_camera *camera, const float w[3], const float t[3])
{
    if (!camera || (w && !disti_finite_all(3, w)) || (t && !disti_finite_all(3, t))) return;
    if (w) disti_turn(w, camera->rotation);
    for (int i = 0; t && i < 3; i++) disti_add_within(&camera->translation[i], (double)t[i]);
}

DIST_API void dist_camera_ray(const dist_camera *camera, float x, float y, float origin[3], float direction[3])
{
    disti_view view;
    double v[3], world[3];
    if (!camera) return;
    disti_view_of(camera, &view);
    disti_view_direction(&view, (double)x, (double)y, v);
    disti_rotate_back(view.rotation, v, world);
    for (int i = 0; i < 3; i++) {
        if (origin) origin[i] = (float)view.center[i];
        if (direction) direction[i] = (float)world[i];
    }
}

/*@ 07 trace -------------------------------------------------------------------------------------------------------- */

typedef struct disti_sample { /* of f, at s along a ray */
    float s, f;
} disti_sample;

/* A ray in the field's space, p(s) = origin + s direction, with origin the point closest to the bounding sphere's
   center, so that s stays within the radius however far the camera is; distance along the ray = base + s. */
typedef struct disti_ray {
    double base;
    float origin[3], direction[3];
    float enter, leave; /* of the bounding sphere, not before the camera; enter >= leave: it is not met */
    float footprint;    /* half a pixel's width at unit distance, cos^2 / (2 f)         (paper, supplement) */
    float cosine;       /* of the angle to the camera's axis: depth = distance * cosine */
    float start, guard; /* where the cones left it, and at most f there (3e38 without cones) */
    float q;            /* where f is wanted next */
    disti_sample front; /* nothing lies before it */
    float slope;        /* df/ds of the last two samples */
    disti_sample a, b;  /* bracket: a.f > 0 >= b.f, a.s < b.s; while marching b: beyond a gap, b.f = 0: none */
    float width;        /* bracket's width at first; before: longest first step to trust, in epsilons */
    float best, fbest;  /* sample of smallest |f| */
    float error;
    disti_sample crept; /* front where samples near the surface began to stand too far apart to prove what is between
                           them; f = 0: they do not. Certified: last sample of 32 noises or more */
    float sign;         /* -1: looking for the way out of the solid */
    unsigned short steps;
    unsigned char mode, status;
    unsigned char known; /* marching: the slope is measured */
    unsigned char side;  /* bracket, band: queries in it so far; marching: steps since a sample beyond was negative */
    unsigned char moved; /* band: 1 if the ray came into it from outside; silhouette: DISTI_UNSURE and so on, or 0 */
    unsigned char aim;   /* 1: the neighbors predict the hit at target, 2: but not how f falls there */
    float target, incline; /* s, df/ds there; bracket: disti_ray_bent, and its own */
    float off;             /* of a hit: how far the neighbors' prediction was from it; 0: there was none */
    unsigned char kept;  /* warm start: verified, not traced; a miss's best is where |f| is least */
    unsigned char own;   /* incline is df/ds at q: the sample came with its gradient; of a hit: it is the normal's */
    float stop;          /* warm start: start as the cones left it; leave if they cleared it */
} disti_ray;

enum {
    DISTI_DONE,
    DISTI_WAIT,    /* its turn has not come */
    DISTI_FIRST,   /* the start of the march; b.f > 0: a second query, before b */
    DISTI_MARCH,   /* a sphere step */
    DISTI_SKIP,    /* past what other rays' samples prove empty */
    DISTI_JUMP,    /* to where f should end */
    DISTI_BACK,    /* back from a start inside */
    DISTI_BAND,    /* 0 < f < epsilon */
    DISTI_LEAST,   /* where f is least in the band */
    DISTI_BRACKET, /* between two signs */
    DISTI_PREDICT  /* where the neighbors say */
};

/* What one call traces with. */
typedef struct disti_tracer {
    dist_context *ctx;
    const dist_field *field;
    dist_render_desc how;
    float lipschitz, epsilon, noise;
    float usual;      /* epsilon where none is told, as far as the field goes */
    float detail;     /* the field's, or its radius: lengths that are taken on trust go by it */
    float far, ratio; /* from |f| = far on the slope is at most lipschitz / ratio */
    const dist_cache *cache; /* that rays are to use; NULL: none */
    float shy;               /* by how much less than it says a ball of it is trusted: to where |f| is epsilon */
} disti_tracer;

/* From 3e38 on, infinity included, but no NaN, also for a compiler that knows none. */
static int disti_endless(float x)
{
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits >= 0x7f61b1e6u && bits <= 0x7f800000u;
}

DIST_API dist_render_desc dist_render_desc_resolve(const dist_render_desc *desc)
{
    dist_render_desc how;
    memset(&how, 0, sizeof how);
    if (desc) how = *desc;
    if (how.max_steps == 0) how.max_steps = how.trace == DIST_TRACE_PAPER ? 50 : how.certified ? 10000 : 300;
    if (how.step_scale == 0.0f) how.step_scale = 1.5f;
    if (how.epsilon == 0.0f && how.trace == DIST_TRACE_PAPER) how.epsilon = 5e-5f;
    if (how.samples == 0) how.samples = 1;
    if (how.gradient == DIST_GRADIENT_AUTO)
        how.gradient = how.trace == DIST_TRACE_PAPER ? DIST_GRADIENT_PAPER : DIST_GRADIENT_IMPLICIT;
    if (how.gradient_cap == 0.0f) how.gradient_cap = 0.1f;
    if (disti_endless(how.max_distance)) how.max_distance = 0.0f;
    return how;
}

static dist_status disti_how_check(dist_context *ctx, const dist_render_desc *how, const char *function)
{
    if (!how) return DIST_OK;
    const double any = 3e38, far = disti_endless(how->max_distance) ? 0.0 : (double)how->max_distance;
    const disti_limit limits[] = {
        {"how.max_steps", (double)how->max_steps, 0, 60000}, {"how.samples", (double)how->samples, 0, 8},
        {"how.trace", (double)how->trace, 0, DIST_TRACE_PAPER},
        {"how.paper_row", (double)how->paper_row, 0, DIST_PAPER_PARALLEL},
        {"how.gradient", (double)how->gradient, 0, DIST_GRADIENT_PAPER},
        {"how.normal_mode", (double)how->normal_mode, 0, DIST_NORMAL_DIFFERENCE},
        {"how.normal_space", (double)how->normal_space, 0, DIST_SPACE_WORLD},
        {"how.inside", (double)how->inside, 0, DIST_INSIDE_EXIT}, {"how.no_cones", (double)how->no_cones, 0, 1},
        {"how.no_prediction", (double)how->no_prediction, 0, 1}, {"how.certified", (double)how->certified, 0, 1},
        {"how.any_hit", (double)how->any_hit, 0, 1}, {"how.max_distance", far, 0, any},
        {"how.warm_start", (double)how->warm_start, 0, 1},
        {"how.step_scale", (double)how->step_scale, 0, 100}, {"how.epsilon", (double)how->epsilon, 0, any},
        {"how.gradient_cap", (double)how->gradient_cap, 0, 1},
        {"how.normal_delta", (double)how->normal_delta, 0, any}, {"how.lipschitz", (double)how->lipschitz, 0, any},
        {"how.relax_band", (double)how->relax_band, 0, any}};
    dist_status status = disti_limits(ctx, function, sizeof limits / sizeof limits[0], limits);
    if (status != DIST_OK) return status;
    if (how->warm_start && how->trace != DIST_TRACE_GUARDED)
        return disti_refuse(ctx, "%s: how.warm_start is for DIST_TRACE_GUARDED, must be 0", function);
    if (how->certified && how->trace != DIST_TRACE_GUARDED)
        return disti_refuse(ctx, "%s: how.certified is for DIST_TRACE_GUARDED, must be 0", function);
    if (!disti_finite(how->background))
        return disti_fail(ctx, DIST_NOT_FINITE, "%s: how.background is %d, must be finite", function,
                          (double)how->background, 0);
    for (int i = 0; i < 3; i++)
        if (!disti_finite(how->background_color[i]))
            return disti_fail(ctx, DIST_NOT_FINITE, "%s: how.background_color[%d] is %d, must be finite", function, i,
                              (double)how->background_color[i]);
#ifdef DIST_NO_PAPER
    if (how->trace == DIST_TRACE_PAPER)
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: this build has DIST_NO_PAPER, so no DIST_TRACE_PAPER", function,
                          0, 0);
#endif
    return DIST_OK;
}

#if !defined(DIST_NO_PAPER) || !defined(DIST_NO_BACKWARD)
/* alpha of a paper row: the two plain ones step by f itself. */
static float disti_paper_alpha(const dist_render_desc *how)
{
    return how->paper_row == DIST_PAPER_COARSE_TO_FINE || how->paper_row == DIST_PAPER_AGGRESSIVE ? how->step_scale
                                                                                                  : 1.0f;
}
#endif

/* What the rounding of f, of numbers of the radius's size, and of points where the field stands may change f by. */
static float disti_field_noise(const dist_field *field)
{
    double c[3] = {(double)field->center[0], (double)field->center[1], (double)field->center[2]};
    return DISTI_MAX(5e-7f * field->radius + (float)(1.2e-7 * sqrt(disti_dot(c, c))), field->noise);
}

static dist_status disti_tracer_init(disti_tracer *tracer, dist_context *ctx, const dist_field *field,
                                     const dist_render_desc *desc, const char *function)
{
    dist_status status = disti_how_check(ctx, desc, function);
    if (status != DIST_OK) return status;
    tracer->ctx = ctx;
    tracer->field = field;
    tracer->how = dist_render_desc_resolve(desc);
    tracer->detail = field->detail > 0.0f ? field->detail : field->radius;
    if (tracer->how.normal_delta == 0.0f) tracer->how.normal_delta = 1e-3f * tracer->detail;
    else if (!(tracer->how.normal_delta >= 1e-6f * field->radius && tracer->how.normal_delta <= field->radius))
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "%s: how.normal_delta is %d, must be 1e-6 to 1 of the field's radius, %d", function,
                          (double)tracer->how.normal_delta, (double)field->radius);
    tracer->lipschitz = tracer->how.lipschitz > 0.0f ? tracer->how.lipschitz
                        : field->lipschitz > 0.0f    ? field->lipschitz
                                                     : 1.0f;
    tracer->far = disti_far_from(field);
    tracer->ratio = 1.0f;
    if (!(tracer->how.lipschitz > 0.0f)) {
        float far = disti_lipschitz_far(field);
        if (tracer->how.certified) {
            tracer->lipschitz = disti_certified(field);
            far = disti_certified_far(field);
        }
        tracer->ratio = tracer->lipschitz / far;
    }
    tracer->noise = disti_field_noise(field);
    tracer->epsilon = tracer->how.epsilon;
    tracer->usual = 5e-5f * tracer->detail;
    if (field->clamp > 0.0f && tracer->how.trace == DIST_TRACE_GUARDED) { /* a clamped f is near nothing */
        tracer->epsilon = DISTI_MIN(tracer->epsilon, 0.5f * field->clamp);
        tracer->usual = DISTI_MIN(tracer->usual, 0.5f * field->clamp);
    }
    tracer->epsilon = DISTI_MAX(tracer->epsilon, tracer->how.epsilon > 0.0f ? tracer->noise : 0.0f);
    tracer->cache = NULL;
    tracer->shy = DISTI_MAX(tracer->epsilon, 5e-5f * tracer->detail) / tracer->lipschitz;
    return DIST_OK;
}

/* Radius of the sphere around a point with this |f| in which the Lipschitz figures allow no surface. */
static float disti_empty(const disti_tracer *tracer, float f)
{
    float beyond = f - tracer->far;
    return (beyond > 0.0f ? tracer->far + beyond * tracer->ratio : f) / tracer->lipschitz;
}

/* center (from the middle of the bounding sphere) and direction (unit) of the ray in the field's space; ray: zeroed.
   The closest approach is found in double: a float's squared distance is off by more than epsilon from 30 radii on. */
DISTI_INLINE void disti_ray_place(const dist_field *field, double cx, double cy, double cz, double dx, double dy,
                                  double dz, double footprint, disti_ray *ray)
{
    double radius = (double)field->radius, along = -(cx * dx + cy * dy + cz * dz);
    double ox = cx + along * dx, oy = cy + along * dy, oz = cz + along * dz;
    double half = radius * radius - (ox * ox + oy * oy + oz * oz);
    ray->origin[0] = (float)(ox + (double)field->center[0]);
    ray->origin[1] = (float)(oy + (double)field->center[1]);
    ray->origin[2] = (float)(oz + (double)field->center[2]);
    ray->direction[0] = (float)dx;
    ray->direction[1] = (float)dy;
    ray->direction[2] = (float)dz;
    ray->base = along;
    ray->cosine = 1.0f;
    ray->footprint = (float)footprint;
    ray->sign = 1.0f;
    ray->fbest = 3e38f;
    half = half > 0.0 ? sqrt(half) : 0.0;
    float enter = (float)(-half > -along ? -half : -along), leave = (float)half; /* nothing behind the camera */
    int meets = half > 0.0 && enter < leave;
    ray->leave = meets ? leave : enter;
    ray->enter = ray->front.s = ray->best = ray->start = ray->q = enter;
    ray->status = DIST_RAY_MISS;
    ray->guard = 3e38f;
    ray->mode = (unsigned char)(meets ? DISTI_FIRST : DISTI_DONE);
}

static void disti_ray_init(const dist_field *field, const double center[3], const double direction[3], double footprint,
                           disti_ray *ray)
{
    memset(ray, 0, sizeof *ray);
    disti_ray_place(field, center[0] - (double)field->center[0], center[1] - (double)field->center[1],
                    center[2] - (double)field->center[2], direction[0], direction[1], direction[2], footprint, ray);
}

/* |f| that counts as the surface at s: epsilon, but no more than half a pixel there, and no less than float's noise. */
static float disti_ray_epsilon(const disti_tracer *tracer, const disti_ray *ray, float s)
{
    if (tracer->epsilon > 0.0f) return tracer->epsilon;
    float pixel = (float)(ray->base + (double)s) * ray->footprint;
    float epsilon = tracer->usual;
    epsilon = ray->footprint > 0.0f && pixel < epsilon ? pixel : epsilon;
    return DISTI_MAX(epsilon, tracer->noise);
}

/* Whether an epsilon is so much larger than the default that over the lengths it allows slopes may differ by twice. */
static int disti_coarse(const disti_tracer *tracer, float epsilon)
{
    return epsilon > 4e-4f * tracer->detail;
}

/* |f| from which on the ray feels its way: a coarse epsilon says how exact a hit is to be, not what may be passed. A
   certified ray marches on until little more than noise is left: its steps are proven, and longer than feeling. */
static float disti_ray_near(const disti_tracer *tracer, const disti_ray *ray, float s)
{
    float most = tracer->how.certified ? 1e-6f : 5e-4f;
    return DISTI_MIN(disti_ray_epsilon(tracer, ray, s), DISTI_MAX(most * tracer->detail, tracer->noise));
}

static int disti_ray_end(disti_ray *ray, int status, float s, float f, float error)
{
    ray->status = (unsigned char)status;
    ray->mode = DISTI_DONE;
    ray->best = s;
    ray->fbest = f * ray->sign;
    ray->error = error;
    return 0;
}

static int disti_ray_miss(disti_ray *ray)
{
    return disti_ray_end(ray, DIST_RAY_MISS, ray->best, ray->fbest * ray->sign, 0.0f);
}

/* Ends a ray whose budget is spent: its best sample, or without one where it would look next. What lies before the
   front is known to be empty; a bracket says more. */
static int disti_ray_give_up(disti_ray *ray)
{
    int mode = ray->mode, begun = mode >= DISTI_MARCH && mode <= DISTI_BRACKET && mode != DISTI_BACK;
    float front = mode == DISTI_BRACKET || mode == DISTI_LEAST ? ray->a.s
                  : mode == DISTI_BACK                         ? ray->enter
                  : begun                                      ? ray->front.s
                                                               : ray->start;
    float end = mode == DISTI_BRACKET || (begun && ray->b.f < 0.0f && ray->b.s > ray->front.s) ? ray->b.s : ray->leave;
    float s = ray->fbest < 2e38f ? ray->best : ray->q;
    return disti_ray_end(ray, DIST_RAY_UNRESOLVED, s, ray->fbest * ray->sign, DISTI_MAX(s - front, end - s));
}

static int disti_ray_ask(disti_ray *ray, int mode, float q)
{
    ray->mode = (unsigned char)mode;
    ray->q = q;
    return 1;
}

/* How far before a hit the surface may be for a ray that came down steeply, but crosses 0 slowly, by `falls`: between
   the two f bends, and where it is as flat as that, ripples of the surface's |f| may have crossed 0 before. Over a
   bracket that is flat from the start they may have done so anywhere in it, and where what was sampled before it says
   that f crosses 0 earlier (disti_ray_bent), from there on; or, if f falls more than twice as steeply as on the way
   along the surface that led here (disti_ray_creeps), anywhere on that way. No less than what f's noise hides: where
   the bracket's ends differ by no more than noise their slope is not known; then it is a 16th of the Lipschitz figure
   or, for a certified ray that grazes, half the mean slope from its last sample well above noise, if that is less. */
static float disti_ray_kink(const disti_tracer *tracer, const disti_ray *ray, float falls)
{
    float most = 0.04f * tracer->field->radius, flat = tracer->noise;
    if (falls < 0.15f * tracer->lipschitz && ray->incline < -2.0f * falls)
        flat = 12.0f * disti_ray_epsilon(tracer, ray, ray->a.s);
    flat = DISTI_MAX(flat < most * falls ? flat / falls : most, ray->target);
    float way = ray->b.s - ray->crept.s;
    int certified = tracer->how.certified, crept = ray->crept.f > 0.0f;
    if (!certified && crept && falls * way > 2.0f * ray->crept.f) flat = DISTI_MAX(flat, DISTI_MIN(way, 0.5f * most));
    if (ray->a.f - ray->b.f < 2.0f * tracer->noise) {
        float slope = tracer->lipschitz / 16.0f;
        if (certified && crept && way > 0.0f)
            slope = DISTI_MIN(slope, 0.5f * (ray->crept.f - 2.0f * tracer->noise) / way);
        flat = DISTI_MAX(flat, tracer->noise / slope);
    }
    return ray->incline > -0.12f * tracer->lipschitz ? DISTI_MAX(flat, DISTI_MIN(ray->width, most)) : flat;
}

/* Bracket [a, b], a.f > 0 >= b.f, finished by ITP (Oliveira and Takahashi 2020): regula falsi, pushed a little toward
   the middle and kept so near it that few more queries are needed than a bisection's. So slope, clamp and kinks cannot
   make it oscillate or crawl, and equal ends cannot divide by 0. */
static int disti_ray_bracket(const disti_tracer *tracer, disti_ray *ray)
{
    float width = ray->b.s - ray->a.s, middle = 0.5f * (ray->a.s + ray->b.s);
    float epsilon = DISTI_MAX(disti_ray_epsilon(tracer, ray, ray->a.s), 2.4e-7f * tracer->field->radius);
    float q = ray->a.f > ray->b.f ? ray->a.s + width * (ray->a.f / (ray->a.f - ray->b.f)) : middle; /* both may be 0 */
    if (width <= epsilon) {
        float falls = (ray->a.f - ray->b.f) / width, before = -ray->slope, error = width;
        if (disti_coarse(tracer, epsilon) && ray->side == 0 && before > 0.0f && falls > 0.0f) {
            /* as below: no farther than |f| takes from an end at a third of the slopes, where two in a row are alike */
            float flatter = DISTI_MIN(falls, before), uneven = DISTI_MAX(falls, before) / flatter;
            float off = 3.0f * DISTI_MIN(ray->a.f, -ray->b.f) * uneven * uneven + tracer->noise;
            if (off < width * flatter) error = DISTI_MAX(off / flatter, 0.5f * width);
        }
        ray->slope = -falls;
        return disti_ray_end(ray, DIST_RAY_HIT, q, 0.0f, DISTI_MAX(error, disti_ray_kink(tracer, ray, falls)));
    }
    float room = epsilon; /* how far from the middle q may lie: what bisection would have left, less half the width */
    while (room < ray->width) room *= 2.0f;
    for (int i = 0; i < ray->side; i++) room *= 0.5f;
    room = DISTI_MAX(room - 0.5f * width, 0.0f);
    float toward = middle > q ? 1.0f : -1.0f;
    float push = ray->side == 0 ? 0.0f : DISTI_MAX(0.1f * width * (width / ray->width), 0.1f * epsilon);
    q = (middle - q) * toward > push ? q + toward * push : middle;
    if ((middle - q) * toward > room) q = middle - toward * room;
    float least = DISTI_MIN(0.125f * epsilon, 0.25f * width); /* never at an end */
    q = DISTI_MIN(DISTI_MAX(q, ray->a.s + least), ray->b.s - least);
    ray->side++;
    return disti_ray_ask(ray, DISTI_BRACKET, q);
}

/* A sample inside the bracket. The error is judged in s: |f| over the slopes to the bracket's ends. */
static int disti_ray_bracketed(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    float tolerance = 0.25f * disti_ray_epsilon(tracer, ray, now.s);
    float slope_a = (ray->a.f - now.f) / (now.s - ray->a.s), slope_b = (now.f - ray->b.f) / (ray->b.s - now.s);
    int inside = now.f <= 0.0f, apart = now.s > ray->a.s && now.s < ray->b.s; /* of an end at it there is no slope */
    float slope = inside ? slope_a : slope_b;
    float other = inside ? slope_b : slope_a;
    float magnitude = fabsf(now.f);
    float aside = other > 0.0f ? other : -other, flatter = DISTI_MIN(slope, aside);
    if (apart && slope > 1e-3f && magnitude <= tolerance * DISTI_MIN(0.5f * slope, flatter)) {
        ray->slope = -slope;
        float width = ray->b.s - ray->a.s, error = width;
        if (flatter > 0.0f && disti_finite(slope + aside)) {
            float off = magnitude * (DISTI_MAX(slope, aside) / flatter) + tracer->noise;
            if (disti_coarse(tracer, 4.0f * tolerance)) off += off;
            if (off < width * flatter) error = off / flatter;
        }
        error = DISTI_MAX(error, disti_ray_kink(tracer, ray, flatter));
        return disti_ray_end(ray, DIST_RAY_HIT, now.s + now.f / slope, 0.0f, error);
    }
    if (inside) ray->b = now;
    else ray->a = now;
    return disti_ray_bracket(tracer, ray);
}

/* How much of the bracket [a, b], a.f > 0 >= b.f, is beyond the empty spheres at its ends: room for other surfaces than
   the one that f crosses. */
static float disti_ray_room(const disti_tracer *tracer, disti_sample a, disti_sample b)
{
    return b.s - a.s - disti_empty(tracer, a.f) - disti_empty(tracer, -b.f);
}

/* Whether that is no more than `most` of the detail; certified: than epsilon, and so near the hit is the first one. */
static int disti_ray_alone(const disti_tracer *tracer, const disti_ray *ray, disti_sample a, disti_sample b, float most)
{
    float room = tracer->how.certified ? disti_ray_epsilon(tracer, ray, ray->front.s) : most * tracer->detail;
    return disti_ray_room(tracer, a, b) <= room;
}

/* How far before the end of a bracket [a, b] f may have crossed 0: the slope before it foretells a crossing at
   a.s + a.f / -slope, and where f falls by less than 0.6 of that slope (chosen, not derived) it has bent on the way,
   above 0 or below. Certified steps allow no crossing before a, and in the bracket none but in its room. */
static float disti_ray_bent(const disti_tracer *tracer, const disti_ray *ray, disti_sample a, disti_sample b)
{
    if (tracer->how.certified) {
        float room = disti_ray_room(tracer, a, b);
        return room > 4.8e-7f * tracer->field->radius ? room : 0.0f;
    }
    if (!ray->known || -0.6f * ray->slope * (b.s - a.s) <= a.f - b.f) return 0.0f;
    return b.s - a.s + a.f / ray->slope;
}

static int disti_ray_marches(const disti_ray *ray)
{
    return ray->mode == DISTI_MARCH || ray->mode == DISTI_SKIP || ray->mode == DISTI_JUMP;
}

/* Into the bracket [a, b], or from the nearest sample in it on, if the march had one and took it back. */
static int disti_ray_open_bracket(const disti_tracer *tracer, disti_ray *ray, disti_sample a, disti_sample b)
{
    disti_sample best = {ray->best, ray->fbest * ray->sign};
    ray->target = disti_ray_bent(tracer, ray, a, b);
    if (disti_ray_marches(ray) && best.s > a.s && best.s < b.s && best.f > 0.0f && best.f < a.f) {
        a = best;
        ray->target = DISTI_MAX(ray->target, disti_ray_bent(tracer, ray, a, b));
    }
    ray->a = a;
    ray->b = b;
    ray->width = b.s - a.s;
    ray->incline = (b.f - a.f) / ray->width;
    ray->side = 0;
    float epsilon = disti_ray_epsilon(tracer, ray, a.s);
    int narrow = ray->width > 0.0f && ray->width <= 2.0f * epsilon;
    if (tracer->how.certified && narrow && a.f > b.f && !disti_coarse(tracer, epsilon)) {
        ray->slope = ray->incline;
        float error = DISTI_MAX(ray->width, disti_ray_kink(tracer, ray, -ray->incline));
        return disti_ray_end(ray, DIST_RAY_HIT, a.s + ray->width * (a.f / (a.f - b.f)), 0.0f, error);
    }
    return disti_ray_bracket(tracer, ray);
}

/* Steps no shorter than this are taken along a surface that the ray hardly approaches: a pixel, from .0005 to .003 of
   the detail, so that what a chord cuts off is a small part of one. They grow from the 20th query on, so that a plateau
   of f ends within the budget. */
static float disti_ray_floor(const disti_tracer *tracer, const disti_ray *ray)
{
    if (tracer->how.certified) return 0.0f;
    float patience = ray->steps > 20 ? 1.0f + 0.1f * (float)(ray->steps - 20) : 1.0f;
    float pixel = 2.0f * (float)(ray->base + (double)ray->front.s) * ray->footprint, radius = tracer->detail;
    return patience * DISTI_MAX(5e-4f * radius, DISTI_MIN(pixel, 3e-3f * radius));
}

/* Notes the front of a step to q that was trusted, though nothing proves it, along a surface so near that ripples of f
   may cross 0 there (to 10 of the default epsilon: chosen by what decoders do, not derived), or past spheres to where f
   is all but 0; until f is larger again. A certified ray takes no such step; it notes the last sample well above noise,
   from which the mean slope to a hit is known. */
static void disti_ray_creeps(const disti_tracer *tracer, disti_ray *ray, disti_sample now, int trusted)
{
    float ripple = 10.0f * tracer->usual;
    if (tracer->how.certified) {
        if (now.f >= 32.0f * tracer->noise) ray->crept = now;
        return;
    }
    int skips = ray->mode == DISTI_SKIP && now.f < disti_ray_near(tracer, ray, now.s);
    if (skips || (trusted && now.f < ripple && ray->slope > -0.3f * tracer->lipschitz)) {
        if (!(ray->crept.f > 0.0f)) ray->crept = ray->front;
    } else if (now.f >= ripple) {
        ray->crept.f = 0.0f;
    }
}

/* A step to where f ends if it falls like that (above 0), at most three spheres or a hundredth of the detail far; 0:
   none is taken. Nothing proves it, so not before a sample that lies in a solid, where what is proven counts; a
   certified ray takes it as soon as the spheres at its two ends leave no more than epsilon between them. */
static float disti_ray_jump(const disti_tracer *tracer, const disti_ray *ray, float falls, float radius)
{
    int solid = ray->b.f < 0.0f, certified = tracer->how.certified;
    float s = ray->front.s, epsilon = certified ? disti_ray_epsilon(tracer, ray, s) : disti_ray_near(tracer, ray, s);
    float jump = ray->front.f / falls, beyond = 1.03f * jump + 0.5f * epsilon;
    if (certified) return jump - radius <= 0.4f * epsilon && !(solid && s + beyond >= ray->b.s) ? beyond : 0.0f;
    float cap = 3.0f * radius + epsilon;
    if (solid || beyond <= cap) return solid ? 0.0f : beyond;
    /* short of the end: f must still be positive there, or something came in between */
    if (DISTI_MAX(ray->front.f, radius) < 5e-3f * tracer->detail)
        cap = DISTI_MAX(cap, 1e-2f * tracer->detail);
    return DISTI_MIN(0.97f * jump, cap);
}

/* Where to look next from the front: near the surface a jump to where the last slope says that f ends, else a sphere
   step, stretched by what the slope allows: for a plane that recedes or comes at the angle seen, 2 / (1 - slope)
   (auto-relaxation), somewhat less as the slope changes. What is found there is checked on arrival; so a certified ray
   may begin with the slope that its neighbors' hits foretell. */
static int disti_ray_step(const disti_tracer *tracer, disti_ray *ray)
{
    float radius = disti_empty(tracer, ray->front.f);
    int certified = tracer->how.certified, told = certified && !ray->known && ray->incline < 0.0f;
    float slope = (told ? ray->incline : ray->slope) / tracer->lipschitz;
    if (ray->b.f < 0.0f && ray->front.s + radius >= ray->b.s) /* not Lipschitz after all */
        return disti_ray_open_bracket(tracer, ray, ray->front, ray->b);
    if (ray->front.s + radius >= ray->leave) return disti_ray_miss(ray);
    float relaxed = (certified ? 1.95f : 1.8f) / (1.0f - DISTI_MIN(slope, 0.75f));
    float stretch = ray->known || told ? DISTI_MAX(1.0f, relaxed) : tracer->how.step_scale;
    float step = radius * DISTI_MIN(stretch, 8.0f), jump = 0.0f;
    int local = ray->a.f > 0.0f; /* the slope; one over what was skipped says nothing of what comes next */
    int tells = told || (ray->known && (local || certified));
    if (tells && slope < -0.05f && DISTI_MAX(ray->front.f, radius) < 0.05f * tracer->detail)
        jump = disti_ray_jump(tracer, ray, told ? -ray->incline : -ray->slope, radius);
    int mode = jump > 0.0f ? DISTI_JUMP : DISTI_MARCH;
    if (jump > 0.0f) step = jump;
    if (ray->known && local && slope > -0.3f) { /* but not through a surface that the slope foretells */
        float floor = disti_ray_floor(tracer, ray);
        if (slope < 0.0f) floor = DISTI_MIN(floor, 0.9f * ray->front.f / -ray->slope);
        step = DISTI_MAX(step, floor);
    }
    float q = ray->front.s + step;
    float spacing = ray->front.s + 2.4e-7f * tracer->field->radius;
    if (ray->b.f > 0.0f && ray->b.s > ray->front.s && q > ray->b.s) { /* into the gap before that, not past it */
        q = 0.5f * (ray->front.s + radius + ray->b.s - disti_empty(tracer, ray->b.f));
        mode = DISTI_MARCH;
    }
    q = DISTI_MAX(q, spacing);
    return disti_ray_ask(ray, mode, DISTI_MIN(q, ray->leave));
}

/* A step that the spheres of radius f / L at its two ends do not cover is taken back, unless it is too short to
   matter or it followed a surface at a low angle and found f about where the slope said or somewhat above, as over one
   that bends away, not almost 0 instead: that may be the far side of what it went through. */
static int disti_ray_trusts(const disti_tracer *tracer, const disti_ray *ray, float f, float step)
{
    float expected = ray->front.f + ray->slope * step;
    if (!ray->known || tracer->how.certified) return 0;
    int creeps = ray->slope > -0.3f * tracer->lipschitz && step <= 1.001f * disti_ray_floor(tracer, ray);
    if (creeps && expected > 0.0f) return 1;
    float off = f - expected;
    if (f < 0.25f * expected && -off > 0.1f * ray->front.f) return 0;
    return ray->mode == DISTI_JUMP && expected > 0.0f && off > -0.3f * ray->front.f && off < 0.5f * ray->front.f;
}

/* A step down from a to s that was trusted though spheres do not cover it, no mere chord, and now f rises from s: does
   it do so from a crossing between the two? */
static int disti_ray_doubts(const disti_tracer *tracer, const disti_ray *ray, float f, float step)
{
    float last = ray->front.s - ray->a.s, before = disti_empty(tracer, ray->a.f), rise = f - ray->front.f;
    if (tracer->how.certified || !(ray->a.f > ray->front.f) || ray->b.f < 0.0f) return 0;
    if (!(rise > 0.0f) || last <= 0.0f) return 0;
    if (last <= before + disti_empty(tracer, ray->front.f) || last <= 2.0f * disti_ray_floor(tracer, ray)) return 0;
    return ray->front.f * step < rise * (last - before);
}

/* Feels ahead in the band 0 < f < epsilon, farther each time: by a hundredth of the detail, or 16 epsilon if that is
   more (beside what it grazes the band is long); certified only as far as is proven empty. */
static int disti_ray_feel(const disti_tracer *tracer, disti_ray *ray, float epsilon)
{
    float most = DISTI_MAX(0.01f * tracer->detail, 16.0f * epsilon), reach = 2.0f * epsilon;
    for (int i = 0; i < ray->side && reach < most; i++) reach *= 1.5f;
    if (ray->slope < -1e-3f) reach = DISTI_MIN(1.2f * ray->front.f / -ray->slope, DISTI_MAX(reach, 64.0f * epsilon));
    reach = tracer->how.certified ? disti_empty(tracer, ray->front.f) : DISTI_MAX(reach, 0.5f * epsilon);
    float q = DISTI_MAX(ray->front.s + reach, ray->front.s + 4.8e-7f * tracer->field->radius);
    return disti_ray_ask(ray, DISTI_BAND, DISTI_MIN(q, ray->leave));
}

/* Past the least f of the band, which lies between a and b, at s as far as is known; f is not negative at all three.
   Where it is convex it stays above its chords continued: as soon as these stay above 0, the ray only came near. Until
   then, or until f < 0, it is looked for in turn where two equal slopes meet, where a parabola is least, and by golden
   sections. A steep least f below half of epsilon may be a sheet that is thinner than floats can tell: a hit; a coarser
   epsilon than the default makes none of what passes by. Where the sides are flat, a least f says nothing, float noise
   has many: the ray goes on. */
static int disti_ray_least(const disti_tracer *tracer, disti_ray *ray)
{
    float before = ray->front.s - ray->a.s, after = ray->b.s - ray->front.s;
    float left = (ray->a.f - ray->front.f) / before, right = (ray->b.f - ray->front.f) / after;
    float drop = DISTI_MAX(right * before, left * after);
    int spent = ray->moved > 12 || ray->b.s - ray->a.s < 4e-6f * tracer->field->radius;
    float epsilon = disti_ray_near(tracer, ray, ray->front.s);
    int flat = DISTI_MAX(ray->a.f, ray->b.f) - ray->front.f < tracer->noise;
    float gentler = DISTI_MIN(left, right);
    float thin = DISTI_MIN(epsilon, DISTI_MAX(tracer->usual, tracer->noise));
    int narrow = gentler > 0.3f * tracer->lipschitz || (gentler > 0.0f && !flat && ray->b.s - ray->a.s < thin);
    int sheet = narrow && ray->front.f < 0.5f * thin; /* too thin to be sure of */
    if (spent || drop < ray->front.f) {
        ray->slope = -left;
        disti_sample lowest = ray->front;
        if (sheet || (!flat && lowest.f <= tracer->noise))
            return disti_ray_end(ray, DIST_RAY_HIT, lowest.s, lowest.f,
                                 lowest.f / tracer->lipschitz + ray->b.s - ray->a.s);
        ray->front = ray->a = ray->b;
        ray->b = lowest;
        ray->slope = right;
        ray->moved = ray->known = 1;
        if (ray->front.s >= ray->leave) return disti_ray_miss(ray);
        if (ray->front.f < 4.0f * epsilon) return disti_ray_feel(tracer, ray, epsilon);
        ray->b.f = 0.0f; /* the band is over */
        return disti_ray_step(tracer, ray);
    }
    float least = 2.4e-7f * tracer->field->radius, steeper = DISTI_MAX(left, right), shift = 0.0f;
    if (ray->moved % 3 == 1 && steeper > 0.0f) shift = 0.5f * ((ray->a.f - ray->b.f) / steeper + after - before);
    else if (ray->moved % 3 == 2 && steeper > 0.0f) shift = 0.5f * (left * after - right * before) / (left + right);
    if ((shift < 0.0f ? -shift : shift) < least) shift = after > before ? 0.38f * after : -0.38f * before;
    ray->moved++;
    return disti_ray_ask(ray, DISTI_LEAST, ray->front.s + shift);
}

static int disti_ray_leasted(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    int beyond = now.s > ray->front.s, lower = now.f < ray->front.f;
    if (now.f <= 0.0f) return disti_ray_open_bracket(tracer, ray, now.s < ray->front.s ? ray->a : ray->front, now);
    disti_sample end = lower ? ray->front : now;
    if (lower != beyond) ray->b = end;
    else ray->a = end;
    if (lower) ray->front = now;
    return disti_ray_least(tracer, ray);
}

/* A certified ray leaves the band by where it came to no more than f's noise: through a sheet thinner than floats can
   tell, or past a solid nearer than that. That is a hit at the least f, off by no more than the noise over the mean
   slope from the last sample well above it. Returns whether it is one. */
static int disti_ray_sheet(const disti_tracer *tracer, disti_ray *ray)
{
    float least = ray->fbest * ray->sign, way = ray->best - ray->crept.s;
    if (!(ray->moved && ray->crept.f > 0.0f && way > 0.0f && least <= tracer->noise)) return 0;
    ray->slope = (least - ray->crept.f) / way;
    float error = 4.8e-7f * tracer->field->radius - tracer->noise / ray->slope;
    disti_ray_end(ray, DIST_RAY_HIT, ray->best, least, error);
    return 1;
}

/* 0 < f < epsilon at the front: the surface is near, if not hit. Leaving the band again (by 4 epsilon) without a
   crossing was no hit, nor is it the surface that the ray began at. f that does not change at all is a plateau. The
   band's first sample stands in a, the last but one in b. */
static int disti_ray_band(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    disti_sample last = ray->front;
    float epsilon = disti_ray_near(tracer, ray, last.s);
    float step = now.s - last.s;
    if (now.f <= 0.0f && last.f > 0.0f) return disti_ray_open_bracket(tracer, ray, last, now);
    if (now.f < 0.0f)
        return disti_ray_end(ray, DIST_RAY_HIT, last.s, 0.0f, 0.0f); /* the start is the surface, to the last bit */
    if (ray->side < 255) ray->side++;
    if (now.f < 0.5f * ray->a.f) ray->moved = 1; /* toward another surface than the one that it began at */
    float fall = ray->b.s < last.s ? (ray->b.f - last.f) / (last.s - ray->b.s) * step : 0.0f; /* as before */
    int rises = now.f >= last.f || (now.f > 0.8f * last.f && fall > last.f);
    if (ray->moved && fall > 0.0f && !tracer->how.certified && rises) {
        ray->a = ray->b;
        ray->b = now;
        return disti_ray_least(tracer, ray);
    }
    if (now.s >= ray->leave) return disti_ray_miss(ray);
    float change = ray->a.f - now.f, all = now.s - ray->a.s;
    ray->b = last;
    ray->front = now;
    ray->slope = (now.f - last.f) / DISTI_MAX(step, 1e-30f);
    if (now.f >= 4.0f * epsilon) {
        if (tracer->how.certified && disti_ray_sheet(tracer, ray)) return 0;
        ray->known = 1;
        ray->b.f = 0.0f; /* the band is over */
        return disti_ray_step(tracer, ray);
    }
    if (tracer->how.certified) { /* on until the steps are spent */
        float rise = now.f - fabsf(ray->fbest); /* beyond the rounding of numbers of the radius's size: no plateau */
        int flat = change < 1e-3f * all && 1e-3f * all > tracer->noise && rise <= 1.2e-7f * tracer->field->radius;
        int zeros = ray->steps >= 1000 && now.f == 0.0f && change == 0.0f; /* a network of zeros */
        int ends = (ray->steps + 1 >= tracer->how.max_steps && flat) || zeros;
        return ends ? disti_ray_end(ray, DIST_RAY_PLATEAU, now.s, now.f, 0.0f) : disti_ray_feel(tracer, ray, epsilon);
    }
    float rise = now.f - fabsf(ray->fbest); /* past the least of a solid that was not met f is no plateau */
    if (ray->side >= 16 && !(change >= 1e-3f * all) && !(rise > 1e-3f * (now.s - ray->best)))
        return disti_ray_end(ray, DIST_RAY_PLATEAU, now.s, now.f, 0.0f);
    if (ray->side >= 16 && now.f <= tracer->noise) { /* it falls, or has passed by within noise */
        float error = change > 0.0f ? now.f * all / change : all + tracer->noise / (tracer->lipschitz / 16.0f);
        return disti_ray_end(ray, DIST_RAY_HIT, now.s, now.f, DISTI_MIN(error, ray->leave - ray->enter));
    }
    if (ray->side >= 48) return disti_ray_give_up(ray); /* it falls, but to where? */
    return disti_ray_feel(tracer, ray, epsilon);
}

/* The field is negative where the ray starts. */
static int disti_ray_inside(const disti_tracer *tracer, disti_ray *ray, float f)
{
    if (tracer->how.inside != DIST_INSIDE_EXIT) return disti_ray_end(ray, DIST_RAY_INSIDE, ray->enter, f, 0.0f);
    ray->sign = -ray->sign;
    ray->front.s = ray->enter;
    ray->front.f = -f;
    ray->best = ray->enter;
    ray->fbest = f;
    ray->slope = ray->a.f = ray->b.f = 0.0f; /* what was found beyond was so with the other sign */
    ray->known = 0;
    return disti_ray_step(tracer, ray);
}

/* Off to where the neighbors predict the hit, if f at the front is no smaller than the predicted surface alone would
   make it: else something nearer is about. */
static int disti_ray_aims(const disti_tracer *tracer, const disti_ray *ray, float f)
{
    float far = -ray->incline * (ray->target - ray->front.s);
    return ray->aim && far > 0.0f && far <= f + 1e-3f * tracer->field->radius && !(ray->b.f < 0.0f);
}

static int disti_ray_aim(disti_ray *ray)
{
    ray->side = ray->aim == 2;
    ray->aim = 0;
    ray->a.f = 3e38f;
    return disti_ray_ask(ray, DISTI_PREDICT, ray->target);
}

/* How far a step of Newton's of this length along a slope may end from the surface. Nothing tells whether f bends on
   the way, out of the solid or into it, most likely where it is flat already; a slope that is not the ray's own says
   little over the lengths of a coarse epsilon: 2, 5, 20 and .75 of epsilon are chosen by what decoders do, not
   derived. */
static float disti_newton_error(const disti_tracer *tracer, float epsilon, float slope, float length, int own)
{
    int coarse = disti_coarse(tracer, epsilon);
    float error = (slope > -0.6f * tracer->lipschitz ? 20.0f : coarse ? 5.0f : 2.0f) * length;
    if (coarse && !own) error = DISTI_MAX(error, 0.75f * epsilon);
    return error - tracer->noise / slope;
}

/* A sample where the neighbors' hits and slopes predicted this ray's: Newton's steps, the first by their slope, as long
   as these are alike (it is off by about its length times 3 % and half of what they differ), the others, and any for a
   sample that came with its gradient, by its own. A step too long to trust, or f that does not shrink, sends the ray
   back to its front. At a grazing angle only a sample behind the surface shows that the ray does not pass it by. */
static int disti_ray_predicted(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    float epsilon = disti_ray_epsilon(tracer, ray, now.s);
    int first = ray->a.f > 2e38f, fronted = ray->front.f > 0.0f, foreign = first && !ray->own;
    float slope = first || ray->own ? ray->incline : (now.f - ray->a.f) / (now.s - ray->a.s);
    float step = -now.f / slope, length = step < 0.0f ? -step : step;
    float magnitude = now.f < 0.0f ? -now.f : now.f, before = ray->a.f < 0.0f ? -ray->a.f : ray->a.f;
    int far = 2.0f * (float)(ray->base + (double)now.s) * ray->footprint > 0.01f * tracer->field->radius;
    if (first && fronted && now.f > 0.0f) before = 0.5f * ray->front.f; /* the front's: it fell, or it ends elsewhere */
    int good = slope < -0.05f * tracer->lipschitz && length < 0.03f * tracer->detail && magnitude < before &&
               ray->side < 5;
    int ends = now.f < epsilon || slope < -0.3f * tracer->lipschitz; /* else f may flatten out before it is 0 */
    if (now.f > 0.0f && slope > -0.12f * tracer->lipschitz) { /* as it does beside an outline */
        ends = 0;
        step *= 1.2f;
    }
    float most = foreign ? ray->width : far ? 1.0f : 12.0f;
    if (good && ends && (!foreign || ray->width > 0.0f) && length <= most * epsilon) {
        float off = now.s + step - ray->target;
        ray->slope = slope;
        if (length > 0.125f * (float)(ray->base + (double)now.s) * ray->footprint) ray->own = 0; /* of a pixel: 1/16 */
        ray->off = DISTI_MAX(off < 0.0f ? -off : off, 1e-9f);
        float error = disti_newton_error(tracer, epsilon, slope, length, ray->own);
        return disti_ray_end(ray, DIST_RAY_HIT, now.s + step, now.f, error);
    }
    if (!good || now.s + step <= (fronted ? ray->front.s : ray->start) || now.s + step >= ray->leave) {
        if (now.f < 0.0f && !(ray->b.f < 0.0f)) ray->b = now;
        ray->a.f = 0.0f;
        ray->side = 0;
        return fronted ? disti_ray_step(tracer, ray) : disti_ray_ask(ray, DISTI_FIRST, ray->start);
    }
    ray->a = now;
    ray->side++;
    return disti_ray_ask(ray, DISTI_PREDICT, now.s + step);
}

/* The front is near the surface: is it hit? */
static int disti_ray_arrive(const disti_tracer *tracer, disti_ray *ray)
{
    if (ray->b.f < 0.0f && ray->b.s > ray->front.s) { /* what is near need not be what is at b */
        if (disti_ray_alone(tracer, ray, ray->front, ray->b, 2e-3f))
            return disti_ray_open_bracket(tracer, ray, ray->front, ray->b);
        if (tracer->how.certified) return disti_ray_step(tracer, ray);
    }
    float epsilon = disti_ray_near(tracer, ray, ray->front.s);
    ray->side = 0;
    ray->moved = ray->slope < 0.0f; /* came down to here from farther out: from a, or where f was epsilon */
    ray->b = ray->a.f > 0.0f ? ray->a : ray->front;
    if (ray->moved && !(ray->a.f > 0.0f)) {
        ray->b.s += (epsilon - ray->front.f) / ray->slope;
        ray->b.f = epsilon;
    }
    ray->a = ray->front;
    return disti_ray_feel(tracer, ray, epsilon);
}

/* On from a new front. */
static int disti_ray_onward(const disti_tracer *tracer, disti_ray *ray)
{
    if (ray->front.f < disti_ray_near(tracer, ray, ray->front.s)) return disti_ray_arrive(tracer, ray);
    if (ray->front.s >= ray->leave) return disti_ray_miss(ray);
    return disti_ray_aims(tracer, ray, ray->front.f) ? disti_ray_aim(ray) : disti_ray_step(tracer, ray);
}

/* The first sample of a ray, or a second one before it. */
static int disti_ray_first(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    if (now.f < 0.0f && now.s <= ray->enter) return disti_ray_inside(tracer, ray, now.f);
    if (now.f < 0.0f) { /* the cone came too far: the Lipschitz figure was too small here */
        ray->b = now;
        ray->width = DISTI_MAX(1.5f * -now.f / tracer->lipschitz, disti_ray_epsilon(tracer, ray, now.s));
        return disti_ray_ask(ray, DISTI_BACK, DISTI_MAX(now.s - ray->width, ray->enter));
    }
    ray->front = now;
    ray->slope = ray->a.f = 0.0f;
    ray->known = 0;
    disti_ray_creeps(tracer, ray, now, 0);
    float near = disti_ray_near(tracer, ray, now.s);
    if (ray->b.f > 0.0f) { /* the second query */
        ray->a = now;
        ray->front = ray->b;
        ray->slope = (ray->b.f - now.f) / (ray->b.s - now.s);
        ray->known = 1;
        ray->b.f = 0.0f;
    } else if (now.f < near && now.s > ray->enter && !(ray->b.f < 0.0f)) {
        ray->b = now; /* cones or other rays' spheres led up to this: does f fall toward it? One looks from before */
        ray->b.f = DISTI_MAX(now.f, 1e-30f); /* 0: none */
        return disti_ray_ask(ray, DISTI_FIRST, DISTI_MAX(now.s - 4.0f * near, ray->enter));
    }
    return disti_ray_onward(tracer, ray);
}

/* A sample farther back than one in a solid. */
static int disti_ray_backed(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    if (now.f >= 0.0f) return disti_ray_open_bracket(tracer, ray, now, ray->b);
    if (now.s <= ray->enter) return disti_ray_inside(tracer, ray, now.f);
    ray->b = now;
    ray->width *= 1.6f;
    return disti_ray_ask(ray, DISTI_BACK, DISTI_MAX(now.s - ray->width, ray->enter));
}

/* A step of the sphere at the front alone, with ray->slope known; none into a solid that was found no farther on. */
static int disti_ray_retry(const disti_tracer *tracer, disti_ray *ray)
{
    float step = DISTI_MAX(disti_empty(tracer, ray->front.f), 4.8e-7f * tracer->field->radius);
    if (ray->b.f < 0.0f && ray->front.s + step >= ray->b.s)
        return disti_ray_open_bracket(tracer, ray, ray->front, ray->b);
    return disti_ray_ask(ray, DISTI_MARCH, DISTI_MIN(ray->front.s + step, ray->leave));
}

/* df/ds between two samples; where f is clamped none is known, and none foretells a surface. */
static float disti_ray_slope(const disti_tracer *tracer, disti_sample from, disti_sample to)
{
    float clamp = tracer->field->clamp > 0.0f ? 0.98f * tracer->field->clamp : 3e38f;
    float slope = (to.f - from.f) / (to.s - from.s);
    return from.f > clamp || to.f > clamp ? DISTI_MAX(slope, 0.0f) : slope;
}

/* The front moves to the new sample, and on to one beyond it if nothing fits between. */
static void disti_ray_move(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    ray->a = ray->front;
    if (ray->mode == DISTI_SKIP) ray->a.f = 0.0f;
    ray->slope = disti_ray_slope(tracer, ray->front, now);
    ray->front = now;
    ray->known = 1;
    float gap = ray->b.s - now.s;
    if (ray->b.f > 0.0f && gap > 0.0f && gap <= disti_empty(tracer, now.f) + disti_empty(tracer, ray->b.f)) {
        ray->slope = disti_ray_slope(tracer, now, ray->b);
        ray->front = ray->b;
        ray->a.f = 0.0f;
    }
    if (gap <= 0.0f) ray->b.f = 0.0f;
}

/* A step of the march from the front to a new sample. */
static int disti_ray_marched(const disti_tracer *tracer, disti_ray *ray, disti_sample now)
{
    float f = now.f, radius = disti_empty(tracer, ray->front.f), step = now.s - ray->front.s;
    if (ray->b.f < 0.0f && f > 0.0f && now.s < ray->b.s && ++ray->side >= 3 && !tracer->how.certified) {
        float slope = (f - ray->front.f) / step, mean = (ray->b.f - f) / (ray->b.s - now.s);
        int steep = slope < -0.05f * tracer->lipschitz, straight = !steep && fabsf(mean - slope) <= -0.1f * mean;
        if (straight || disti_ray_alone(tracer, ray, now, ray->b, 2e-3f))
            return disti_ray_open_bracket(tracer, ray, now, ray->b);
        if (steep) ray->b.f = 0.0f; /* what is near may be another solid: on as if b were not known, with jumps again */
    }
    float gap = step - radius - disti_empty(tracer, fabsf(f)); /* what neither sphere covers */
    gap += 0.25f * tracer->noise / tracer->lipschitz; /* at a flat sheet spheres touch */
    float sphere = (tracer->how.certified ? 1.0f : 1.0001f) * radius + 4.8e-7f * tracer->field->radius;
    int back = ray->mode != DISTI_SKIP && step > sphere;
    float off = f - (ray->front.f + ray->slope * step);
    int foretold = ray->known && fabsf(off) < 0.5f * (off - f); /* as deep as expected */
    float room = (foretold ? 2e-2f : 1e-3f) * tracer->detail;
    if (tracer->how.certified) room = disti_ray_epsilon(tracer, ray, ray->front.s);
    if (f <= 0.0f && !(back && gap > room)) return disti_ray_open_bracket(tracer, ray, ray->front, now);
    if (back && (f <= 0.0f || (gap > 0.0f && !disti_ray_trusts(tracer, ray, f, step)))) {
        float slope = (f - ray->front.f) / step; /* something may hide in the gap: back, and keep the far sample */
        ray->slope = DISTI_MAX(slope, -tracer->lipschitz);
        ray->known = 1;
        if (f <= 0.0f || !(ray->b.f < 0.0f)) {
            ray->side = 0;
            ray->b = now;
        }
        return disti_ray_retry(tracer, ray);
    }
    if (disti_ray_doubts(tracer, ray, f, step)) { /* back to where the last step began, and keep where it ended */
        ray->slope = (ray->front.f - ray->a.f) / (ray->front.s - ray->a.s);
        ray->b = ray->front;
        ray->front = ray->a;
        ray->a.f = 0.0f;
        return disti_ray_retry(tracer, ray);
    }
    disti_ray_creeps(tracer, ray, now, back && gap > 0.0f);
    if (ray->b.f < 0.0f) { /* a crossing lies before b: is there room for another before it? */
        if (ray->b.s <= now.s) return disti_ray_open_bracket(tracer, ray, ray->front, ray->b);
        if (disti_ray_alone(tracer, ray, now, ray->b, 1e-3f)) return disti_ray_open_bracket(tracer, ray, now, ray->b);
    }
    disti_ray_move(tracer, ray, now);
    return disti_ray_onward(tracer, ray);
}

/* The march's budget is spent, and b lies in a solid: it is hit, but there may be another in the room before it, from
   the end of the front's sphere on. */
static int disti_ray_end_march(const disti_tracer *tracer, disti_ray *ray, disti_sample b)
{
    disti_sample a = ray->front;
    int alone = disti_ray_alone(tracer, ray, a, b, 1e-3f), goes = disti_ray_open_bracket(tracer, ray, a, b);
    float first = b.s - a.s - disti_empty(tracer, a.f);
    if (!alone) ray->target = DISTI_MAX(ray->target, first);
    if (!alone && !goes) ray->error = DISTI_MAX(ray->error, first);
    return goes;
}

static void disti_keep_least(disti_ray *ray, float s, float f)
{
    if (!disti_finite(f) || fabsf(f) >= fabsf(ray->fbest)) return;
    ray->best = s;
    ray->fbest = f;
}

/* One sample f at ray->q: what follows from it. 1: another query at ray->q; 0: done, ray->status says how. */
static int disti_ray_advance(const disti_tracer *tracer, disti_ray *ray, float sample)
{
    disti_sample now = {ray->q, sample * ray->sign};
    if (!disti_finite(sample)) return disti_ray_end(ray, DIST_RAY_NOT_FINITE, now.s, 0.0f, 0.0f);
    disti_keep_least(ray, now.s, sample);
    int spent = ++ray->steps >= tracer->how.max_steps && (now.f > 0.0f || disti_ray_marches(ray));
    if (tracer->how.any_hit && now.f < 0.0f && ray->mode != DISTI_FIRST)
        return disti_ray_end(ray, DIST_RAY_HIT, now.s, now.f, now.s - ray->front.s);
    if (ray->mode == DISTI_BRACKET) {
        if (ray->steps < tracer->how.max_steps + 40) return disti_ray_bracketed(tracer, ray, now);
        float width = ray->b.s - ray->a.s;
        return disti_ray_end(ray, DIST_RAY_HIT, 0.5f * (ray->a.s + ray->b.s), 0.0f, DISTI_MAX(width, ray->target));
    }
    if (spent && now.f <= 0.0f) return disti_ray_end_march(tracer, ray, now);
    if (spent && ray->mode != DISTI_BAND && ray->b.f < 0.0f && ray->b.s > ray->front.s)
        return disti_ray_end_march(tracer, ray, ray->b);
    if (spent) return disti_ray_give_up(ray);
    switch (ray->mode) {
    case DISTI_FIRST: return disti_ray_first(tracer, ray, now);
    case DISTI_BACK: return disti_ray_backed(tracer, ray, now);
    case DISTI_BAND: return disti_ray_band(tracer, ray, now);
    case DISTI_LEAST: return disti_ray_leasted(tracer, ray, now);
    case DISTI_PREDICT: return disti_ray_predicted(tracer, ray, now);
    }
    return disti_ray_marched(tracer, ray, now); /* DISTI_MARCH, DISTI_SKIP, DISTI_JUMP */
}

/* A worker's share of the tracer's memory. */
enum { DISTI_TILE = 88, DISTI_TILE_USUAL = 64, DISTI_TILE_RAYS = (DISTI_TILE + 1) * (DISTI_TILE + 1) };

/* Spheres that samples of the tile's rays prove empty, and the parts of each ray that those of the rays around it
   cover, looked up when it sets out. A ray that is about to step skips what is covered. Pool full: no more are kept. */
enum { DISTI_POOL = 2816, DISTI_BALLS = 12, DISTI_COVERS = 12, DISTI_SPANS = 20 * DISTI_BALLS };
/* A ray looks at the pixels up to DISTI_WINDOW to the right and below, and less than that to the left and above. */
enum { DISTI_WINDOW = 4, DISTI_LOOKED = 4 * DISTI_WINDOW * DISTI_WINDOW };

typedef struct disti_cover {
    float begin, end; /* covered without a gap; what lies before is of no use */
    int count;        /* of the parts beyond the gap: disjoint, in order */
    float from[DISTI_COVERS], to[DISTI_COVERS];
} disti_cover;

typedef struct disti_clear { /* a pixel's largest balls */
    int count;
    float s[DISTI_BALLS], square[DISTI_BALLS]; /* where along its ray; of the radius, 0 beyond the last */
} disti_clear;

typedef struct disti_balls {
    int stride;                               /* rays look at every stride-th pixel */
    int clears, covers;                       /* taken of the pools */
    unsigned char reach[DISTI_TILE_RAYS];     /* square of the pixel's largest radius in pixels, 1 to 255; 0: no ball */
    unsigned short clear_of[DISTI_TILE_RAYS]; /* the place of a pixel's balls, if it has any */
    unsigned short cover_of[DISTI_TILE_RAYS]; /* 1 + the place of its ray's cover; 0: not looked up yet */
    disti_clear clear[DISTI_POOL];
    disti_cover cover[DISTI_POOL];
} disti_balls;

/* A task's share of how.max_queries. Each hit owes per_hit queries for its normal and color, so while marching a query
   that may find one must leave room for them. */
typedef struct disti_budget {
    unsigned long long left, hits, per_hit;
    int marching;
} disti_budget;

/* Where the axes of the cones over 8 x 8 pixels had the least f: distance from the camera, f (3e38: no sample), and
   how far outside the bounding sphere, which counts only where there was no other. */
enum {
    DISTI_LEAST_BLOCK = 8,
    DISTI_LEAST_ROW = (int)DISTI_TILE / DISTI_LEAST_BLOCK,
    DISTI_LEASTS = DISTI_LEAST_ROW * DISTI_LEAST_ROW
};
typedef struct disti_least {
    float t[DISTI_LEASTS], f[DISTI_LEASTS], out[DISTI_LEASTS];
} disti_least;

typedef struct disti_bench { /* the work bench of one task */
    dist_stats *stats;
    disti_budget *budget; /* NULL: no limit */
    disti_ray *rays;   /* DISTI_TILE_RAYS */
    float *points;     /* (DISTI_TILE_RAYS, 3) */
    float *sdf;        /* DISTI_TILE_RAYS */
    float *gradient;   /* NULL, or (2, DISTI_TILE_RAYS, 3): of a round's samples, and grad f at hits that are `own` */
    float *depth;      /* DISTI_TILE_RAYS: of the rays that are hits so far, for their neighbors; 0: none,
                          below: nor has it set out */
    int *index;        /* DISTI_TILE_RAYS */
    unsigned char *rest; /* what else a task wants: DISTI_REST_BYTES */
    disti_balls *balls;  /* NULL: rays do not share */
    disti_least *least_of;
    int width, height;   /* of the tile */
    float least;         /* smallest ball worth keeping */
    int cones;           /* in rest, until something else is put there: the tile's */
} disti_bench;

enum { DISTI_REST_BYTES = 640 * 1024 };

static void disti_bench_init(const dist_context *ctx, int worker, disti_bench *bench)
{
    unsigned char *base = disti_scratch(ctx, worker) + DISTI_COUNTER_BYTES;
    size_t at = 0;
    bench->stats = (dist_stats *)disti_take(base, &at, 1, sizeof(dist_stats));
    bench->rays = (disti_ray *)disti_take(base, &at, DISTI_TILE_RAYS, sizeof(disti_ray));
    bench->points = (float *)disti_take(base, &at, DISTI_TILE_RAYS, 3 * sizeof(float));
    bench->sdf = (float *)disti_take(base, &at, DISTI_TILE_RAYS, sizeof(float));
    bench->depth = (float *)disti_take(base, &at, DISTI_TILE_RAYS, sizeof(float));
    bench->index = (int *)disti_take(base, &at, DISTI_TILE_RAYS, sizeof(int));
    bench->rest = (unsigned char *)disti_take(base, &at, DISTI_REST_BYTES, 1);
    bench->least_of = (disti_least *)disti_take(base, &at, 1, sizeof(disti_least));
    bench->balls = NULL;
    bench->gradient = NULL;
    bench->budget = NULL;
    bench->width = bench->height = bench->cones = 0;
    bench->least = 0.0f;
    DIST_ASSERT(at <= DISTI_TRACE_BYTES);
}

/* What of how.max_queries goes to the first `part` of `whole` equal parts. Differences of it are the tasks' shares, so
   their sum is exact. */
static unsigned long long disti_share(const disti_tracer *tracer, double part, double whole)
{
    unsigned long long most = DISTI_MIN(tracer->how.max_queries, 1ull << 53);
    return part >= whole ? most : (unsigned long long)((double)most * (part / whole));
}

/* Evaluates f at the first `count` of bench->points, or at as many as the budget has room for, and its gradient at the
   first `sloped` of them; returns how many. */
static size_t disti_query_sloped(const disti_tracer *tracer, int worker, const disti_bench *bench, size_t count,
                                 size_t sloped)
{
    const dist_field *field = tracer->field;
    disti_budget *budget = bench->budget;
    if (budget) {
        unsigned long long owed = budget->hits * budget->per_hit, room = budget->left > owed ? budget->left - owed : 0;
        if (budget->marching) room /= 1 + budget->per_hit;
        count = (size_t)DISTI_MIN((unsigned long long)count, room);
        budget->left -= count;
    }
    sloped = DISTI_MIN((sloped + DISTI_BLOCK - 1) / DISTI_BLOCK * DISTI_BLOCK, count); /* others fill its last block */
    if (sloped > 0) field->eval_fn(field->user, worker, sloped, bench->points, bench->sdf, bench->gradient);
    if (count > sloped)
        field->eval_fn(field->user, worker, count - sloped, bench->points + 3 * sloped, bench->sdf + sloped, NULL);
    bench->stats->queries += count;
    return count;
}

static size_t disti_query(const disti_tracer *tracer, int worker, const disti_bench *bench, size_t count)
{
    return disti_query_sloped(tracer, worker, bench, count, 0);
}

static void disti_ray_point(const disti_ray *ray, float s, float p[3])
{
    for (int i = 0; i < 3; i++) p[i] = ray->origin[i] + s * ray->direction[i];
}

/* From now on rays look at every stride-th pixel, and none has looked yet: the covers' places are free again. */
static void disti_balls_look(const disti_bench *bench, int stride)
{
    disti_balls *balls = bench->balls;
    balls->stride = stride;
    balls->covers = 0;
    memset(balls->cover_of, 0, (size_t)(bench->width * bench->height) * sizeof *balls->cover_of);
}

/* Adds [from, to] to the parts beyond the end; where all places are taken the farthest gives way. */
static void disti_cover_add(disti_cover *cover, float from, float to)
{
    int k = 0, n = cover->count;
    while (k < n && cover->to[k] < from) k++;
    int last = k; /* it meets parts k to last - 1: one */
    for (; last < n && cover->from[last] <= to; last++) {
        from = DISTI_MIN(from, cover->from[last]);
        to = DISTI_MAX(to, cover->to[last]);
    }
    if (last == k && n == DISTI_COVERS) {
        if (k == n) return;
        n--;
    }
    size_t behind = (size_t)(n - last) * sizeof(float);
    memmove(cover->from + k + 1, cover->from + last, behind);
    memmove(cover->to + k + 1, cover->to + last, behind);
    cover->count = n + 1 - (last - k);
    cover->from[k] = from;
    cover->to[k] = to;
}

/* Moves the cover's end to behind the parts that it meets, and drops these. */
static float disti_cover_end(disti_cover *cover)
{
    int k = 0;
    for (; k < cover->count && cover->from[k] <= cover->end; k++) cover->end = DISTI_MAX(cover->end, cover->to[k]);
    if (k == 0) return cover->end;
    cover->count -= k;
    memmove(cover->from, cover->from + k, (size_t)cover->count * sizeof(float));
    memmove(cover->to, cover->to + k, (size_t)cover->count * sizeof(float));
    return cover->end;
}

static void disti_publish(const disti_tracer *tracer, const disti_bench *bench, int index, float f)
{
    disti_balls *balls = bench->balls;
    const disti_ray *ray = &bench->rays[index];
    float radius = disti_empty(tracer, f), square = radius * radius;
    if (!(radius > bench->least)) return;
    if (balls->cover_of[index]) {
        disti_cover *cover = &balls->cover[balls->cover_of[index] - 1];
        if (ray->q - radius <= cover->end) cover->end = DISTI_MAX(cover->end, ray->q + radius);
        else disti_cover_add(cover, ray->q - radius, ray->q + radius);
    }
    if (balls->reach[index] == 0) {
        if (balls->clears == DISTI_POOL) return;
        balls->clear_of[index] = (unsigned short)balls->clears;
        memset(&balls->clear[balls->clears++], 0, sizeof(disti_clear));
    }
    disti_clear *clear = &balls->clear[balls->clear_of[index]];
    int place = clear->count;
    if (place < DISTI_BALLS) {
        clear->count++;
    } else { /* instead of the smallest */
        place = 0;
        for (int i = 1; i < DISTI_BALLS; i++) place = clear->square[i] < clear->square[place] ? i : place;
        if (clear->square[place] >= square) return;
    }
    clear->s[place] = ray->q;
    clear->square[place] = square;
    float pixels = radius / (((float)ray->base + ray->q) * ray->footprint * 2.0f);
    int reach = pixels > 0.0f && pixels < 15.9f ? DISTI_MAX((int)(pixels * pixels), 1) : 255;
    balls->reach[index] = (unsigned char)DISTI_MAX(reach, (int)balls->reach[index]);
}

/* Fills in the cover of a ray, whose end is where it sets out: of the spans that the balls of the pixels around it have
   on it, those that join the end move it on, then the others join each other, from the nearest on. Of a ray o + s v
   and ours, O + S V, with e = o - O and w = v - V: S = e.V + s + s w.V, off by e + s w without its part along V. */
static void disti_cover_begin(const disti_bench *bench, int index, const disti_ray *ray, disti_cover *cover)
{
    const disti_balls *balls = bench->balls;
    float from[DISTI_SPANS], to[DISTI_SPANS], next = 0.0f;
    int width = bench->width, x = index % width, y = index / width, h = balls->stride, n = 0;
    int x0 = DISTI_MAX(x - DISTI_WINDOW + h, 0) / h * h, x1 = DISTI_MIN(x + DISTI_WINDOW, width - 1);
    int y0 = DISTI_MAX(y - DISTI_WINDOW + h, 0) / h * h, y1 = DISTI_MIN(y + DISTI_WINDOW, bench->height - 1);
    int found[DISTI_LOOKED], count = 0; /* listed without a branch, which could not be foretold */
    for (int row = y0; row <= y1; row += h) {
        const unsigned char *reach = balls->reach + row * width;
        for (int u = x0, most = (row - y) * (row - y); u <= x1; u += h) {
            DIST_ASSERT(count < DISTI_LOOKED);
            found[count] = row * width + u;
            count += reach[u] >= DISTI_MAX(most + (u - x) * (u - x), 1);
        }
    }
    for (int k = 0; k < count && n <= DISTI_SPANS - DISTI_BALLS; k++) {
        const disti_ray *other = &bench->rays[found[k]];
        const disti_clear *clear = &balls->clear[balls->clear_of[found[k]]];
        float e[3], w[3], line[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int i = 0; i < 3; i++) {
            e[i] = other->origin[i] - ray->origin[i];
            w[i] = other->direction[i] - ray->direction[i];
            line[0] += e[i] * ray->direction[i];
            line[1] += w[i] * ray->direction[i];
        }
        for (int i = 0; i < 3; i++) {
            float a = e[i] - line[0] * ray->direction[i], b = w[i] - line[1] * ray->direction[i];
            line[2] += a * a;
            line[3] += 2.0f * a * b;
            line[4] += b * b;
        }
        int balls_there = (clear->count + 3) / 4 * 4;
        disti_spans(clear->s, clear->square, balls_there, line, from + n, to + n);
        n += balls_there;
    }
    cover->end = disti_spans_end(from, to, n, cover->end, &next);
    for (cover->count = 0; cover->count < DISTI_COVERS && next < 3e38f; cover->count++) {
        cover->from[cover->count] = next;
        cover->to[cover->count] = disti_spans_end(from, to, n, next, &next);
    }
}

/* How far along the ray the balls around it cover it without a gap, from s on. */
static float disti_covered(const disti_bench *bench, int index, const disti_ray *ray, float s)
{
    disti_balls *balls = bench->balls;
    int looked = balls->cover_of[index] > 0;
    if (!looked && balls->covers == DISTI_POOL) return s;
    if (!looked) balls->cover_of[index] = (unsigned short)++balls->covers;
    disti_cover *cover = &balls->cover[balls->cover_of[index] - 1];
    if (!looked || s < cover->begin || s > cover->end) cover->begin = cover->end = s;
    if (looked) return disti_cover_end(cover);
    disti_cover_begin(bench, index, ray, cover);
    return cover->end;
}

/* Radius of a cache's ball, which holds no surface, about the center of the cell that p is in; d: p, from there. */
DISTI_INLINE float disti_cache_ball(const dist_cache *cache, const float p[3], float d[3])
{
    size_t at = 0;
    float last = (float)(cache->resolution - 1);
    for (int i = 2; i >= 0; i--) {
        float cell = (p[i] - cache->corner[i]) * cache->inverse;
        cell = DISTI_MIN(DISTI_MAX(cell, 0.0f), last);
        at = at * (size_t)cache->resolution + (size_t)cell;
        d[i] = p[i] - cache->corner[i] - ((float)(int)cell + 0.5f) * cache->cell;
    }
    return (float)cache->at[at] * cache->unit;
}

/* No surface is nearer to p than this. */
static float disti_cache_clear(const dist_cache *cache, const float p[3])
{
    float d[3], radius = disti_cache_ball(cache, p, d);
    return DISTI_MAX(radius - disti_length(d[0], d[1], d[2]), 0.0f);
}

/* How far a ray may go for balls that follow one another from `from` on: to there where none holds that, else to s. */
static float disti_cache_walk(const disti_tracer *tracer, const disti_ray *ray, float s, float from)
{
    const dist_cache *cache = tracer->cache;
    float least = 0.05f * cache->cell, end = DISTI_MAX(s, from);
    while (end < ray->leave) {
        float p[3], d[3], along = 0.0f, square = 0.0f;
        disti_ray_point(ray, end, p);
        float radius = disti_cache_ball(cache, p, d) - tracer->shy;
        for (int i = 0; i < 3; i++) {
            along += d[i] * ray->direction[i];
            square += d[i] * d[i];
        }
        if (!(radius > 0.0f) || square >= radius * radius) break;
        float step = sqrtf(along * along - square + radius * radius) - along;
        if (step < least) break;
        s = end += step;
    }
    return s;
}

/* Moves a ray that is about to step past what is known to be empty. 0: it is through. */
static int disti_skip(const disti_tracer *tracer, const disti_bench *bench, int index, disti_ray *ray)
{
    if (ray->mode != DISTI_FIRST && ray->mode != DISTI_MARCH && ray->mode != DISTI_SKIP) return 1;
    int begins = ray->mode == DISTI_FIRST;
    if (begins && ray->b.f > 0.0f) return 1; /* it has been there */
    float s = begins ? ray->q : ray->front.s;
    if (bench->balls) s = disti_covered(bench, index, ray, s);
    if (tracer->cache && ray->sign > 0.0f) /* on the way out what is empty is what it looks for */
        s = disti_cache_walk(tracer, ray, s, begins ? s : ray->front.s + disti_empty(tracer, ray->front.f));
    if (s >= ray->leave) return disti_ray_miss(ray);
    if (s <= ray->q) return 1;
    ray->q = s;
    if (begins) ray->start = s;
    else ray->mode = DISTI_SKIP;
    return 1;
}

/* Mask of a finished ray: a hit, or a start inside the solid where that counts as one. */
static int disti_ray_is_hit(const disti_tracer *tracer, const disti_ray *ray)
{
    return ray->status == DIST_RAY_HIT || (ray->status == DIST_RAY_INSIDE && tracer->how.inside == DIST_INSIDE_HIT);
}

/* Notes what the sample f at ray->q says of the Lipschitz figures. Steps are proven if E(f) = disti_empty is no more
   than the distance from the surface; of two points at distance d, |E(f1) - E(f0)| <= d, or E(f1) + E(-f0) where the
   signs differ. A ratio above 1 calls for as much larger figures; float noise in f is left out. */
DISTI_INLINE void disti_stats_slope(const disti_tracer *tracer, const disti_ray *ray, float f, dist_stats *stats)
{
    int bracket = ray->mode == DISTI_BRACKET || ray->mode == DISTI_LEAST, back = ray->mode == DISTI_BACK;
    if (ray->mode <= DISTI_FIRST || ray->mode == DISTI_PREDICT) return;
    float from = (bracket ? ray->a.f : back ? ray->b.f : ray->front.f) * ray->sign;
    float step = back ? ray->b.s - ray->q : ray->q - (bracket ? ray->a.s : ray->front.s);
    float change = f > from ? f - from : from - f, noise = 2.0f * tracer->noise;
    if (!(change * DISTI_MAX(tracer->ratio, 1.0f) > tracer->lipschitz * step + noise) || !(step > 0.0f)) return;
    float e0 = disti_empty(tracer, from < 0.0f ? -from : from), e1 = disti_empty(tracer, f < 0.0f ? -f : f);
    float rise = ((from < 0.0f) != (f < 0.0f) ? e0 + e1 : e0 > e1 ? e0 - e1 : e1 - e0) * tracer->lipschitz - noise;
    if (rise > tracer->lipschitz * step && rise > stats->steepest * step && disti_finite(rise / step))
        stats->steepest = rise / step;
}

/* The ray's distance from where it sets out: exactly 0 there, and never behind it. */
static double disti_ray_along(const disti_ray *ray)
{
    return ray->best > (float)-ray->base ? ray->base + (double)ray->best : 0.0;
}

static float disti_hit_depth(const disti_ray *ray)
{
    if (ray->status != DIST_RAY_HIT || ray->mode != DISTI_DONE) return 0.0f;
    return (float)(ray->base + (double)ray->best) * ray->cosine;
}

/* Where grad f of the ray's last sample stands, if that is `own`. */
static float *disti_bench_gradient(const disti_bench *bench, int index)
{
    return bench->gradient + 3 * (DISTI_TILE_RAYS + (size_t)index);
}

/* Marches the `active` rays listed in bench->index, in rounds: one packed batch of points a round, until only `enough`
   are left. Returns how many are still listed. Without budget they stay as they are: 0. With bench->gradient predicted
   samples come with their gradients: most are the last of their rays, next to the hit, and serve the normals, too. */
static size_t disti_trace_rounds(const disti_tracer *tracer, int worker, const disti_bench *bench, size_t active,
                                 size_t enough)
{
    int skips = bench->balls || tracer->cache;
    while (active > enough) {
        size_t kept = 0, sloped = 0;
        for (size_t i = 0; i < active; i++) {
            int index = bench->index[i];
            disti_ray *ray = &bench->rays[index];
            if (skips && !disti_skip(tracer, bench, index, ray)) continue;
            ray->own = bench->gradient && ray->mode == DISTI_PREDICT;
            size_t place = ray->own ? sloped++ : kept;
            if (place < kept) { /* those with gradients stand first: another makes room */
                memcpy(bench->points + 3 * kept, bench->points + 3 * place, 3 * sizeof(float));
                bench->index[kept] = bench->index[place];
            }
            disti_ray_point(ray, ray->q, bench->points + 3 * place);
            bench->index[place] = index;
            kept++;
        }
        size_t asked = disti_query_sloped(tracer, worker, bench, kept, sloped);
        active = kept;
        kept = 0;
        for (size_t i = 0; i < asked; i++) {
            int index = bench->index[i];
            disti_ray *ray = &bench->rays[index];
            if (ray->own) {
                const float *g = bench->gradient + 3 * i, *v = ray->direction;
                ray->incline = (g[0] * v[0] + g[1] * v[1] + g[2] * v[2]) * ray->sign;
                memcpy(disti_bench_gradient(bench, index), g, 3 * sizeof(float));
            }
            if (ray->mode >= DISTI_BAND) bench->stats->refine_queries++;
            else bench->stats->march_queries++;
            if (bench->balls) disti_publish(tracer, bench, index, bench->sdf[i]);
            disti_stats_slope(tracer, ray, bench->sdf[i], bench->stats);
            if (disti_ray_advance(tracer, ray, bench->sdf[i])) {
                bench->index[kept++] = index;
                continue;
            }
            bench->depth[index] = disti_hit_depth(ray);
            if (bench->budget) bench->budget->hits += (unsigned)disti_ray_is_hit(tracer, ray);
        }
        if (asked < active) return 0;
        active = kept;
    }
    return active;
}

/* All rays that are not done. */
static void disti_trace_all(const disti_tracer *tracer, int worker, const disti_bench *bench, size_t n)
{
    size_t active = 0;
    for (size_t i = 0; i < n; i++) {
        bench->depth[i] = disti_hit_depth(&bench->rays[i]); /* of a warm start */
        if (bench->rays[i].mode != DISTI_DONE) bench->index[active++] = (int)i;
    }
    disti_trace_rounds(tracer, worker, bench, active, 0);
}

/* Ends the rays for which no budget was left. */
static void disti_trace_end(const disti_tracer *tracer, const disti_bench *bench, size_t n)
{
    unsigned long long hits = 0;
    for (size_t i = 0; i < n && bench->budget; i++) {
        disti_ray *ray = &bench->rays[i];
        if (ray->mode != DISTI_DONE) disti_ray_give_up(ray);
        if (!disti_ray_is_hit(tracer, ray)) continue; /* one without a query of its own may find nothing left for it */
        if ((hits + 1) * bench->budget->per_hit > bench->budget->left) ray->status = DIST_RAY_UNRESOLVED;
        else hits++;
    }
    if (bench->budget) bench->budget->hits = hits;
}

static void disti_stats_begin(dist_context *ctx)
{
    for (int worker = 0; worker < ctx->workers; worker++) {
        disti_bench bench;
        disti_bench_init(ctx, worker, &bench);
        memset(bench.stats, 0, sizeof *bench.stats);
        memset(disti_counter_of(ctx, worker), 0, sizeof(disti_counter));
    }
}

/* Counts are whole numbers and extremes: the order of the workers does not matter. */
static void disti_stats_end(dist_context *ctx, const disti_tracer *tracer, dist_stats *out)
{
    if (!out) return;
    memset(out, 0, sizeof *out);
    out->epsilon = 3e38f;
    for (int worker = 0; worker < ctx->workers; worker++) {
        disti_bench bench;
        disti_bench_init(ctx, worker, &bench);
        const dist_stats *s = bench.stats;
        out->rays += s->rays;
        out->rays_in_sphere += s->rays_in_sphere;
        out->queries += s->queries;
        out->cone_queries += s->cone_queries;
        out->march_queries += s->march_queries;
        out->refine_queries += s->refine_queries;
        out->silhouette_queries += s->silhouette_queries;
        out->normal_queries += s->normal_queries;
        out->color_queries += s->color_queries;
        out->hits += s->hits;
        out->unresolved += s->unresolved;
        out->inside += s->inside;
        out->plateau += s->plateau;
        out->not_finite += s->not_finite;
        out->operations += disti_counter_of(ctx, worker)->dense;
        out->operations_done += disti_counter_of(ctx, worker)->done;
        if (s->steepest > out->steepest) out->steepest = s->steepest;
        if (s->error > out->error) out->error = s->error; /* not -0 over 0, which would tell the workers' order */
        if (s->epsilon > 0.0f) out->epsilon = DISTI_MIN(out->epsilon, s->epsilon);
    }
    if (out->epsilon > 1e38f) out->epsilon = tracer->epsilon > 0.0f ? tracer->epsilon : tracer->usual;
    out->lipschitz = tracer->lipschitz;
}

/* Of a field whose Lipschitz figure nobody has told, f at some places and a step on in the direction in which it rises,
   found by a step along each axis: a steep one's cones and rays may leave the sphere at once, with no second sample to
   tell. */
static void disti_stats_steepest(dist_context *ctx, const disti_tracer *tracer, dist_stats *out)
{
    enum { MOST = 16 };
    const dist_field *field = tracer->field;
    float points[MOST * 4 * 3], on[MOST * 3], sdf[MOST * 4], then[MOST];
    double step = (double)field->radius / 64.0;
    if (!out || out->rays < 256 || field->lipschitz > 0.0f || tracer->how.lipschitz > 0.0f) return;
    size_t n = out->rays < 256 * MOST ? (size_t)(out->rays / 256) : (size_t)MOST;
    if (tracer->how.max_queries > 0 && out->queries + 5 * n > tracer->how.max_queries) return;
    unsigned state = disti_float_state_enter();
    for (size_t i = 0; i < n; i++) { /* spread over the ball */
        double z = 1.0 - (2.0 * (double)i + 1.0) / (double)MOST, r = sqrt(1.0 - z * z), turn = 2.399963 * (double)i;
        double far = 0.95 * pow(((double)(5 * i % MOST) + 0.5) / (double)MOST, 1.0 / 3.0) * (double)field->radius;
        const double at[3] = {r * cos(turn), r * sin(turn), z};
        for (size_t j = 0; j < 12; j++)
            points[12 * i + j] = (float)((double)field->center[j % 3] + far * at[j % 3] +
                                         (j / 3 == 1 + j % 3 ? step : 0.0));
    }
    disti_field_eval_all(ctx, field, 4 * n, points, sdf, NULL);
    for (size_t i = 0; i < n; i++) {
        double rise[3];
        for (size_t k = 0; k < 3; k++) rise[k] = (double)sdf[4 * i + 1 + k] - (double)sdf[4 * i];
        if (!disti_finite_double(disti_dot(rise, rise))) memset(rise, 0, sizeof rise);
        disti_normalize(rise);
        for (size_t k = 0; k < 3; k++) on[3 * i + k] = (float)((double)points[12 * i + k] + step * rise[k]);
    }
    disti_field_eval_all(ctx, field, n, on, then, NULL);
    out->queries += 5 * n;
    out->march_queries += 5 * n;
    for (size_t i = 0; i < n; i++) {
        float slope = (float)(((double)then[i] - (double)sdf[4 * i]) / step);
        if (disti_finite(slope) && slope > 1.001f * tracer->lipschitz && slope > out->steepest) out->steepest = slope;
    }
    disti_float_state_leave(state);
}

/* What is told of the error: the distance goes out as a float, which rounds off up to 2^-24 of it; and where f is off
   by coarse_error, its zero is by that over the slope, which is the exact f's: two samples of a field that is rough by
   that much tell of none above half the Lipschitz figure. */
static float disti_ray_bound(const disti_tracer *tracer, const disti_ray *ray)
{
    const dist_field *field = tracer->field;
    double distance = ray->base + (double)ray->best, coarse = 0.0;
    if (tracer->how.trace == DIST_TRACE_PAPER) return ray->error; /* |f|, no bound */
    if (ray->status != DIST_RAY_HIT && ray->status != DIST_RAY_UNRESOLVED) return ray->error;
    if (disti_is_coarse(field)) {
        float slope = ray->slope < 0.0f ? -ray->slope : ray->slope, most = 0.5f * tracer->lipschitz;
        if (slope > 4.0f * most) slope = 0.06f * tracer->lipschitz; /* a crossing of the noise's, not of f */
        slope = slope > 0.0f && slope < most ? DISTI_MAX(slope, 0.06f * tracer->lipschitz) : most;
        coarse = (double)field->coarse_error / (double)slope;
    }
    return (float)((double)ray->error + coarse + 6e-8 * fabs(distance));
}

static void disti_stats_ray(const disti_tracer *tracer, const disti_ray *ray, dist_stats *stats)
{
    if (ray->status == DIST_RAY_SKIPPED) return;
    stats->rays++;
    stats->rays_in_sphere += ray->enter < ray->leave;
    stats->hits += (unsigned)disti_ray_is_hit(tracer, ray);
    stats->unresolved += ray->status == DIST_RAY_UNRESOLVED;
    stats->inside += ray->status == DIST_RAY_INSIDE;
    stats->plateau += ray->status == DIST_RAY_PLATEAU;
    stats->not_finite += ray->status == DIST_RAY_NOT_FINITE;
    if (ray->status != DIST_RAY_HIT) return;
    float epsilon = disti_ray_epsilon(tracer, ray, ray->best);
    float error = disti_ray_bound(tracer, ray);
    if (error > stats->error) stats->error = error;
    stats->epsilon = stats->epsilon > 0.0f ? DISTI_MIN(stats->epsilon, epsilon) : epsilon;
}

typedef struct disti_free_job {
    const disti_tracer *tracer;
    size_t n;
    const float *origins, *directions;
    dist_hit *hits;
} disti_free_job;

enum { DISTI_FREE_RAYS = 1024 };

static void disti_free_task(void *arg, int index, int worker)
{
    const disti_free_job *job = (const disti_free_job *)arg;
    disti_bench bench;
    disti_bench_init(job->tracer->ctx, worker, &bench);
    size_t first = (size_t)index * DISTI_FREE_RAYS;
    size_t n = DISTI_MIN((size_t)DISTI_FREE_RAYS, job->n - first);
    for (size_t i = 0; i < n; i++) {
        double o[3], d[3];
        for (size_t k = 0; k < 3; k++) {
            o[k] = (double)job->origins[3 * (first + i) + k];
            d[k] = (double)job->directions[3 * (first + i) + k];
        }
        double end = (double)job->tracer->how.max_distance * sqrt(disti_dot(d, d));
        int good = disti_finite_all(3, job->origins + 3 * (first + i)) &&
                   disti_finite_all(3, job->directions + 3 * (first + i)) && disti_normalize(d);
        if (!good) o[0] = o[1] = o[2] = d[0] = d[1] = d[2] = 0.0;
        disti_ray *ray = &bench.rays[i];
        disti_ray_init(job->tracer->field, o, d, 0.0, ray);
        if (end > 0.0 && end - ray->base < (double)ray->leave) {
            int starts = !(ray->enter > (float)-ray->base); /* in the sphere; whether in the solid is asked anyway */
            ray->leave = DISTI_MAX(ray->enter, (float)(end - ray->base));
            if (ray->leave <= ray->enter && starts) ray->leave = ray->enter + 1.2e-7f * job->tracer->field->radius;
            if (ray->leave <= ray->enter) ray->mode = DISTI_DONE;
        }
        if (!good) disti_ray_end(&bench.rays[i], DIST_RAY_NOT_FINITE, 0.0f, 0.0f, 0.0f);
    }
    disti_budget budget;
    memset(&budget, 0, sizeof budget);
    budget.left = disti_share(job->tracer, (double)(first + n), (double)job->n) -
                  disti_share(job->tracer, (double)first, (double)job->n);
    if (job->tracer->how.max_queries > 0) bench.budget = &budget;
    disti_trace_all(job->tracer, worker, &bench, n);
    disti_trace_end(job->tracer, &bench, n);
    for (size_t i = 0; i < n; i++) {
        const disti_ray *ray = &bench.rays[i];
        dist_hit *hit = job->hits + first + i;
        disti_stats_ray(job->tracer, ray, bench.stats);
        hit->distance = disti_within_float(disti_ray_along(ray));
        hit->error = disti_ray_bound(job->tracer, ray);
        hit->sdf = ray->fbest;
        hit->status = ray->status;
    }
}

DIST_API dist_status dist_trace(dist_context *ctx, const dist_field *field, size_t n, const float *origins,
                                const float *directions, const dist_render_desc *how, dist_hit *hits, dist_stats *stats)
{
    disti_tracer tracer;
    dist_status status = disti_enter(ctx, "dist_trace");
    if (status == DIST_OK) status = disti_field_check(ctx, field, "dist_trace");
    if (status == DIST_OK) status = disti_count_check(ctx, n, "dist_trace");
    if (status == DIST_OK) status = disti_tracer_init(&tracer, ctx, field, how, "dist_trace");
    if (status != DIST_OK) return status;
    if (n > 0 && (!origins || !directions || !hits))
        return disti_refuse(ctx, "dist_trace: %s is NULL", !origins ? "origins" : !directions ? "directions" : "hits");
    if (tracer.how.pixels)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "dist_trace: how.pixels is for pictures, must be NULL", NULL, 0, 0);
    if (tracer.how.trace != DIST_TRACE_GUARDED || tracer.how.warm_start)
        return disti_refuse(ctx, "dist_trace: how.%s is for pictures, must be 0",
                            tracer.how.warm_start ? "warm_start" : "trace DIST_TRACE_PAPER");
    tracer.cache = field->cache;
    if (tracer.cache && tracer.how.certified && tracer.how.lipschitz == 0.0f &&
        (tracer.lipschitz > tracer.cache->lipschitz || disti_certified_far(field) > tracer.cache->lipschitz_far))
        tracer.cache = NULL;
    float most = field->cache ? DISTI_MIN(field->cache->lipschitz, field->cache->lipschitz_far) : 0.0f;
    if (field->cache && tracer.how.lipschitz > most)
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          "dist_trace: how.lipschitz is %d, must be at most the %d that field.cache was made with; "
                          "raise field.lipschitz and lipschitz_far before dist_cache_create", NULL,
                          (double)tracer.how.lipschitz, (double)most);
    disti_stats_begin(ctx);
    disti_free_job job = {&tracer, n, origins, directions, hits};
    disti_run(ctx, (int)((n + DISTI_FREE_RAYS - 1) / DISTI_FREE_RAYS), disti_free_task, &job);
    disti_stats_end(ctx, &tracer, stats);
    disti_stats_steepest(ctx, &tracer, stats);
    return DIST_OK;
}

/* A cache: a grid over the bounding sphere's cube of balls about the cells' centers that hold no surface, by f there,
   as far as it is positive: of radius E(f) = disti_empty. (Where the center lies outside the bounding sphere f is asked
   for on that, at a distance o: E(f) - o.) Bricks of 8 cells a side fall into eight, down to cells, unless the ball
   about their middle holds 1.25 of them, more than all, as balls are rounded down by up to a quarter of a cell; then
   each cell gets E less the way to its center. So it takes a query for each cell that the surface is near, and few
   elsewhere. */
enum { DISTI_BRICK = 8, DISTI_BRICKS = 8, DISTI_BRICK_CELLS = DISTI_BRICK * DISTI_BRICK * DISTI_BRICK };

typedef struct disti_cell {
    unsigned short x, y, z;
    float away; /* of where it is asked from its center */
} disti_cell;

/* A ball of this radius about the middle of `size` cells a side. */
static void disti_cache_fill(const dist_cache *cache, const disti_cell *cell, int size, float radius)
{
    size_t n = (size_t)cache->resolution;
    for (int i = 0, count = size * size * size; i < count; i++) {
        int x = i % size, y = i / size % size, z = i / size / size;
        float half = 0.5f * (float)(size - 1), way = disti_length((float)x - half, (float)y - half, (float)z - half);
        float units = (radius - way * cache->cell) / cache->unit;
        size_t at = (((size_t)cell->z + (size_t)z) * n + cell->y + (size_t)y) * n + cell->x + (size_t)x;
        cache->at[at] = (unsigned char)(units > 0.0f ? DISTI_MIN(units, 255.0f) : 0.0f);
    }
}

typedef struct disti_cache_job {
    dist_cache *cache;
    const disti_tracer *tracer;
} disti_cache_job;

/* Eight bricks, in a row along x. */
static void disti_cache_task(void *arg, int index, int worker)
{
    const disti_cache_job *job = (const disti_cache_job *)arg;
    const dist_cache *cache = job->cache;
    const dist_field *field = &cache->field;
    disti_bench bench;
    disti_bench_init(cache->ctx, worker, &bench);
    disti_cell *cell = (disti_cell *)(void *)bench.rest, *next = cell + DISTI_BRICKS * DISTI_BRICK_CELLS;
    int side = cache->resolution / DISTI_BRICK, rows = (side + DISTI_BRICKS - 1) / DISTI_BRICKS, count = 0;
    int x = index % rows * DISTI_BRICKS, y = index / rows % side, z = index / rows / side;
    DIST_ASSERT(2 * DISTI_BRICKS * DISTI_BRICK_CELLS * sizeof(disti_cell) <= DISTI_REST_BYTES);
    for (; x < side && count < DISTI_BRICKS; x++, count++) {
        cell[count].x = (unsigned short)(x * DISTI_BRICK);
        cell[count].y = (unsigned short)(y * DISTI_BRICK);
        cell[count].z = (unsigned short)(z * DISTI_BRICK);
    }
    for (int size = DISTI_BRICK; count > 0; size /= 2) {
        float half = 0.5f * (float)size, corner = 1.7320509f * half * cache->cell;
        size_t asked = 0, opened = 0;
        for (int i = 0; i < count; i++) {
            const float at[3] = {(float)cell[i].x, (float)cell[i].y, (float)cell[i].z};
            float *p = bench.points + 3 * asked, d[3];
            for (int k = 0; k < 3; k++) p[k] = cache->corner[k] + (at[k] + half) * cache->cell;
            for (int k = 0; k < 3; k++) d[k] = p[k] - field->center[k];
            float length = disti_length(d[0], d[1], d[2]), away = DISTI_MAX(length - field->radius, 0.0f);
            if (away > corner) { /* no ray comes there */
                disti_cache_fill(cache, &cell[i], size, 0.0f);
                continue;
            }
            for (int k = 0; k < 3 && away > 0.0f; k++) p[k] = field->center[k] + d[k] * (field->radius / length);
            cell[asked] = cell[i];
            cell[asked++].away = away;
        }
        asked = disti_query(job->tracer, worker, &bench, asked);
        for (size_t i = 0; i < asked; i++) {
            float f = bench.sdf[i], radius = disti_finite(f) ? disti_empty(job->tracer, f) : 0.0f;
            radius += f > 0.0f ? -cell[i].away : cell[i].away;
            if (size == 1 || radius > 1.25f * corner || radius < -corner) {
                disti_cache_fill(cache, &cell[i], size, radius);
                continue;
            }
            for (int k = 0; k < 8; k++) {
                disti_cell *part = &next[opened++];
                *part = cell[i];
                part->x = (unsigned short)(part->x + (k & 1 ? size / 2 : 0));
                part->y = (unsigned short)(part->y + (k & 2 ? size / 2 : 0));
                part->z = (unsigned short)(part->z + (k & 4 ? size / 2 : 0));
            }
        }
        disti_cell *done = cell;
        cell = next;
        next = done;
        count = (int)opened;
    }
}

static dist_status disti_cache_make(dist_cache *cache, const dist_field *field, const char *function)
{
    disti_tracer tracer;
    dist_stats stats;
    dist_context *ctx = cache->ctx;
    dist_field own;
    memset(&own, 0, sizeof own);
    if (field) own = *field;
    own.cache = NULL; /* maybe this one, of what the field was before */
    dist_status status = disti_field_check(ctx, field ? &own : NULL, function);
    if (status == DIST_OK) status = disti_tracer_init(&tracer, ctx, &own, NULL, function);
    if (status != DIST_OK) return status;
    cache->field = own;
    cache->changes = disti_changes(&own);
    cache->cell = 2.0f * own.radius / (float)cache->resolution;
    cache->inverse = 1.0f / cache->cell;
    cache->unit = 0.25f * cache->cell;
    cache->lipschitz = tracer.lipschitz;
    cache->lipschitz_far = disti_lipschitz_far(&own);
    for (int i = 0; i < 3; i++) cache->corner[i] = own.center[i] - own.radius;
    disti_stats_begin(ctx);
    disti_cache_job job = {cache, &tracer};
    int side = cache->resolution / DISTI_BRICK;
    disti_run(ctx, side * side * ((side + DISTI_BRICKS - 1) / DISTI_BRICKS), disti_cache_task, &job);
    disti_stats_end(ctx, &tracer, &stats);
    cache->queries = stats.queries;
    return DIST_OK;
}

/* format: of a sentence on the resolution. */
static dist_status disti_cache_take(dist_context *ctx, int resolution, const char *format, const char *function,
                                    dist_cache *cache)
{
    memset(cache, 0, sizeof *cache);
    cache->ctx = ctx;
    if (resolution < 0 || resolution > 512 || resolution % DISTI_BRICK)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, format, function, resolution, 0);
    cache->resolution = resolution ? resolution : 64;
    size_t n = (size_t)cache->resolution;
    cache->at = (unsigned char *)disti_alloc(ctx, n * n * n);
    return cache->at ? DIST_OK : DIST_OUT_OF_MEMORY;
}

DIST_API dist_cache *dist_cache_create(dist_context *ctx, const dist_field *field, int resolution)
{
    const char *name = "dist_cache_create";
    if (disti_enter(ctx, name) != DIST_OK) return NULL;
    dist_cache *cache = (dist_cache *)disti_alloc(ctx, sizeof *cache);
    if (!cache) return NULL;
    dist_status status = disti_cache_take(
        ctx, resolution, "%s: resolution is %d, must be a multiple of 8 to 512 (0: 64)", name, cache);
    if (status == DIST_OK) status = disti_cache_make(cache, field, name);
    if (status == DIST_OK) return cache;
    dist_cache_destroy(cache);
    return NULL;
}

DIST_API void dist_cache_destroy(dist_cache *cache)
{
    if (!cache) return;
    size_t n = (size_t)cache->resolution;
    disti_free(cache->ctx, cache->at, n * n * n);
    disti_free(cache->ctx, cache, sizeof *cache);
}

DIST_API dist_status dist_cache_update(dist_cache *cache, const dist_field *field)
{
    if (!cache) return DIST_BAD_ARGUMENT;
    dist_status status = disti_enter(cache->ctx, "dist_cache_update");
    return status == DIST_OK ? disti_cache_make(cache, field, "dist_cache_update") : status;
}

DIST_API dist_field dist_cache_field(const dist_cache *cache)
{
    dist_field field;
    memset(&field, 0, sizeof field);
    if (!cache) return field;
    field = cache->field;
    field.cache = cache;
    return field;
}

DIST_API unsigned long long dist_cache_queries(const dist_cache *cache) { return cache ? cache->queries : 0; }

/* Nearest points and contacts. Steps of Newton along the gradient lead from p onto the surface, P; of a distance that
   is all. (Where f is flat they are whole ones only to a 50th of the radius.) From there it slides: with each step down
   also along the surface, toward where its tangent plane is nearest to p. That takes a few queries where the surface
   is smooth, and may come to no end in a crease. Then it looks around for nearer parts that no gradient leads to: in
   the cells of an octree that are not shown to be empty, those nearest to p first, a few steps of Newton's from their
   centers tell of a place on the surface; from the nearest of them it slides again. What a cell tells is told to all
   points of a task. At last, from the nearest x found, a share of the way back to p and down again,
   x' = P(x + share (p - x)), which stays where x is nearest, in creases too, cannot overshoot where the surface bends
   away, and may find another part of the surface, before this one; a quarter of the share where that came no nearer. */
typedef struct disti_foot_cell {
    float empty;   /* there is no surface nearer to its center */
    float seed[3]; /* the next sample; of a leaf that is `on` a place on the surface */
    signed char normal[3]; /* there, times 127 */
    unsigned char steps, on, done, asked; /* asked: it is among tree->asked */
} disti_foot_cell;

typedef struct disti_foot_tree {
    const dist_field *field;
    disti_foot_cell *cells; /* cell 1: the cube around the bounding sphere; 8 k to 8 k + 7: cell k cut in eight */
    int *asked; /* the cells whose seeds are evaluated beside the feet's next points */
    int count, spare; /* of those; while it is less than spare, some are asked for that no foot waits for yet */
    int used;
} disti_foot_tree;

typedef struct disti_foot {
    float p[3], x[3];
    float best[3], normal[3]; /* nearest surface point so far, grad f there at unit length; before there is one: the
                                 last samples outside and inside */
    float distance;  /* from p to it, 3e38: none yet; of a miss: the least there can be */
    float least;     /* no surface is nearer to p than this */
    float radius;    /* p is a sphere's center; 3e38: none */
    float away;      /* of p from the bounding sphere; 0: within */
    float f, damping, share;
    float rest[3], relax; /* the last slide's, and by which share of it */
    float from[3], drift[3]; /* of a pull: the nearest point before it, and by how much more it is to go on; of a
                                look around: where it set out */
    float sign;
    int cell;        /* of a look around: which is waited for; 0: none is under way */
    float hope[3];   /* the nearest place that was told of so far */
    double hoped, wanted, tried; /* how much nearer that leads; what is worth it; how much nearer the hope before did */
    double slide;                /* what of it is a slide's, see disti_foot_note */
    unsigned char status, steps, slides, sides; /* sides: 1 a sample was outside, 2 inside */
    unsigned char begun;  /* steps when it set out for the surface the last time */
    unsigned char landed; /* it has been on the surface since */
    unsigned char pulled; /* the last move was a pull */
    unsigned char settled; /* no way along the surface leads nearer to p */
    unsigned char looks, found; /* looks so far; the last one found something */
    unsigned char doubt;  /* of a scene: DISTI_DOUBT_* */
    int first;            /* the leaf whose sphere is nearest; clear: how near that is, then what was not gone to */
    float clear;
} disti_foot;

enum { DISTI_FEET = 512, DISTI_FOOT_STEPS = 160, DISTI_FOOT_TURN = 48, DISTI_FOOT_SLIDES = 16, DISTI_FOOT_LOOKS = 5,
       DISTI_FOOT_LEAVES = 8 * 8 * 8 * 8, DISTI_FOOT_CELLS = 2 * DISTI_FOOT_LEAVES, DISTI_FOOT_NEWTON = 18,
       DISTI_FOOT_BLOCK = 32, DISTI_FOOT_AHEAD = 64 };

/* Of a way to a point as far off as a float can say, whose square it cannot. */
static float disti_foot_length(const float d[3])
{
    double x = (double)d[0], y = (double)d[1], z = (double)d[2], length = sqrt(x * x + y * y + z * z);
    return (float)DISTI_MIN(length, 3e38);
}

/* Moves x by `step` times n and keeps it in the bounding sphere. Returns how far out it would have been. */
static float disti_foot_move(const dist_field *field, float *x, const float *n, float step)
{
    const float *c = field->center;
    for (int i = 0; i < 3; i++) x[i] += step * n[i];
    float d[3] = {x[0] - c[0], x[1] - c[1], x[2] - c[2]}, length = disti_foot_length(d);
    for (int i = 0; i < 3 && length > field->radius; i++) x[i] = c[i] + (x[i] - c[i]) / length * field->radius;
    return DISTI_MAX(length - field->radius, 0.0f);
}

/* From p to x. */
static double disti_foot_way(const disti_foot *foot, const double x[3])
{
    double d[3] = {(double)foot->p[0] - x[0], (double)foot->p[1] - x[1], (double)foot->p[2] - x[2]};
    return sqrt(disti_dot(d, d));
}

/* How much nearer to p y is than x, which is `way` off: of p far away that is less than distances can tell,
   |p - x| - |p - y| = (y - x) . (2 p - y - x) / (their sum). */
static double disti_foot_gain(const disti_foot *foot, const double x[3], double way, const double y[3])
{
    double gain = 0.0;
    for (int i = 0; i < 3; i++) gain += (y[i] - x[i]) * (2.0 * (double)foot->p[i] - y[i] - x[i]);
    return gain / DISTI_MAX(way + disti_foot_way(foot, y), 1e-300);
}

/* Notes x, which is on the surface with the normal n, if it is the nearest so far. Returns by how much. */
static float disti_foot_arrive(disti_foot *foot, const float *n)
{
    const double x[3] = {(double)foot->x[0], (double)foot->x[1], (double)foot->x[2]};
    const double best[3] = {(double)foot->best[0], (double)foot->best[1], (double)foot->best[2]};
    int first = foot->status != DIST_RAY_HIT;
    float distance = (float)DISTI_MIN(disti_foot_way(foot, x), 3e38);
    double gain = (double)(foot->distance - distance);
    if (!first) gain = disti_foot_gain(foot, best, disti_foot_way(foot, best), x);
    if (gain > 0.0 || first) {
        memcpy(foot->best, foot->x, sizeof foot->best);
        memcpy(foot->normal, n, sizeof foot->normal);
        foot->distance = distance;
    }
    foot->status = DIST_RAY_HIT;
    return disti_within_float(gain);
}

/* Slides toward where the plane at x across n, a distance `down` against it, is nearest to p: along the surface by a
   share of r, the way to p without its part along n. Where the surface is bent that goes too far or not far enough; two
   in a row tell by how much (Aitken's relaxation): share' = -share r . (r' - r) / |r' - r|^2. 0: r is so short that no
   more than a millionth of the radius is to be gained, |r|^2 / (2 |p - x|). */
static int disti_foot_slide(const dist_field *field, disti_foot *foot, const float *n, float down, int on)
{
    float d[3], rest[3], along = 0.0f, square = 0.0f, change = 0.0f, both = 0.0f;
    float reach = DISTI_MIN(0.1f * field->radius, field->clamp > 0.0f ? 0.5f * field->clamp : field->radius);
    for (int i = 0; i < 3; i++) {
        d[i] = foot->p[i] - foot->x[i];
        along += d[i] * n[i];
    }
    for (int i = 0; i < 3; i++) {
        rest[i] = d[i] - along * n[i];
        square += rest[i] * rest[i];
        change += (rest[i] - foot->rest[i]) * (rest[i] - foot->rest[i]);
        both += foot->rest[i] * (rest[i] - foot->rest[i]);
    }
    if (on && square <= 2e-6f * field->radius * disti_foot_length(d)) return 0;
    if (foot->slides++ > 0 && change > 0.0f)
        foot->relax = DISTI_MIN(DISTI_MAX(-foot->relax * both / change, 0.05f), 2.0f);
    memcpy(foot->rest, rest, sizeof rest);
    float share = DISTI_MIN(foot->relax, reach / sqrtf(DISTI_MAX(square, 1e-30f)));
    for (int i = 0; i < 3; i++) foot->x[i] -= down * n[i];
    disti_foot_move(field, foot->x, rest, share);
    return 1;
}

/* From the nearest point so far a share of the way back to p, or to where that leaves the bounding sphere: from there
   the surface is no nearer elsewhere, either. Of p far away that brings x on by little; then what a pull brought is
   doubled in the next as long as x comes nearer, and quartered else. */
static int disti_foot_pull(const dist_field *field, disti_foot *foot, float gain)
{
    float d[3], r = field->radius, reach = field->clamp > 0.0f ? 0.5f * field->clamp : 2.0f * r;
    float way = foot->distance, along = 0.0f, square = 0.0f, drift = 0.0f;
    for (int i = 0; i < 3; i++) {
        float x = foot->best[i] - field->center[i];
        d[i] = (foot->p[i] - foot->best[i]) / DISTI_MAX(way, 1e-30f);
        along += x * d[i];
        square += x * x;
    }
    way = DISTI_MIN(way, sqrtf(DISTI_MAX(along * along + r * r - square, 0.0f)) - along);
    int far = foot->pulled && way < 0.5f * foot->distance;
    for (int i = 0; i < 3; i++) {
        float more = gain > 0.0f ? 2.0f * (foot->best[i] - foot->from[i]) : 0.25f * foot->drift[i];
        foot->drift[i] = far ? more : 0.0f;
        drift += foot->drift[i] * foot->drift[i];
    }
    int drifts = drift > 1e-8f * r * r;
    if (!drifts) memset(foot->drift, 0, sizeof foot->drift);
    if (gain < 1e-5f * r && !drifts) foot->share *= 0.25f;
    if (foot->share < 0.02f) return 0;
    memcpy(foot->from, foot->best, sizeof foot->from);
    memcpy(foot->x, foot->best, sizeof foot->x);
    disti_foot_move(field, foot->x, foot->drift, 1.0f);
    disti_foot_move(field, foot->x, d, DISTI_MIN(foot->share * way, reach));
    foot->pulled = 1;
    foot->begun = foot->steps;
    foot->damping = 1.0f;
    foot->f = 0.0f;
    return 1;
}

/* No surface is nearer than this to where |f| = f, by the figures for how.certified. */
static float disti_certified_empty(const dist_field *field, float f)
{
    float near = disti_certified(field), from = disti_far_from(field);
    return f > from ? from / near + (f - from) / disti_certified_far(field) : f / near;
}

/* The center of a cell and half its side. */
static double disti_foot_cube(const dist_field *field, int cell, double center[3])
{
    double scale = 1.0, at[3] = {0.0, 0.0, 0.0}, radius = (double)field->radius;
    for (; cell > 1; cell >>= 3, scale *= 2.0)
        for (int i = 0; i < 3; i++) at[i] += cell >> i & 1 ? scale : -scale;
    for (int i = 0; i < 3; i++) center[i] = (double)field->center[i] + at[i] / scale * radius;
    return radius / scale;
}

/* The part of a cell that is nearest to p. */
static int disti_foot_corner(const disti_foot *foot, const double center[3])
{
    int corner = 0;
    for (int i = 0; i < 3; i++) corner |= ((double)foot->p[i] > center[i]) << i;
    return corner;
}

/* On from a cell to the next one, with its center and half its side: its part that is nearest to p if `inner`, or else
   the next one that it is a part with. */
static int disti_foot_next(const disti_foot *foot, int cell, int inner, double center[3], double *half)
{
    int turn = inner ? 0 : 8;
    while (turn == 8) {
        int was = cell & 7;
        if (cell <= 1) return 0;
        for (int i = 0; i < 3; i++) center[i] += was >> i & 1 ? -*half : *half;
        *half *= 2.0;
        cell >>= 3;
        turn = (was ^ disti_foot_corner(foot, center)) + 1;
    }
    int part = turn ^ disti_foot_corner(foot, center);
    *half *= 0.5;
    for (int i = 0; i < 3; i++) center[i] += part >> i & 1 ? *half : -*half;
    return 8 * cell + part;
}

/* Whether there is something of a cell in the bounding sphere that is nearer to p than x, `way` off, and what is hoped
   for. */
static int disti_foot_promising(const dist_field *field, const disti_foot *foot, const double x[3], double way,
                                const double center[3], double half)
{
    double radius = (double)field->radius, to_p[3], out[3];
    for (int i = 0; i < 3; i++) {
        double low = center[i] - half, high = center[i] + half, c = (double)field->center[i];
        to_p[i] = DISTI_MIN(DISTI_MAX((double)foot->p[i], low), high);
        out[i] = DISTI_MIN(DISTI_MAX(c, low), high) - c;
    }
    if (disti_dot(out, out) >= radius * radius) return 0;
    return disti_foot_gain(foot, x, way, to_p) > DISTI_MAX(foot->hoped, foot->wanted);
}

/* Puts a cell among those that are evaluated next, but for one that the cache shows to be empty. */
static void disti_foot_ask(disti_foot_tree *tree, int number, const double center[3], double half)
{
    const float zero[3] = {0.0f, 0.0f, 0.0f};
    const dist_field *field = tree->field;
    disti_foot_cell *cell = &tree->cells[number];
    for (int i = 0; i < 3; i++) cell->seed[i] = (float)center[i];
    disti_foot_move(field, cell->seed, zero, 0.0f);
    cell->empty = field->cache ? disti_cache_clear(field->cache, cell->seed) : 0.0f;
    cell->done = (double)cell->empty >= 1.7321 * half;
    cell->asked = !cell->done;
    if (cell->asked) tree->asked[tree->count++] = number;
}

/* A cell's sample f with gradient g at its seed. 1: another one is wanted. */
static int disti_foot_told(const disti_foot_tree *tree, int number, float f, const float *g)
{
    const dist_field *field = tree->field;
    disti_foot_cell *cell = &tree->cells[number];
    double center[3], half = disti_foot_cube(field, number, center);
    float size = f < 0.0f ? -f : f, lipschitz = field->lipschitz > 0.0f ? field->lipschitz : 1.0f;
    float slope = disti_length(g[0], g[1], g[2]), side = (float)half;
    float step = DISTI_MIN(DISTI_MAX(f / DISTI_MAX(slope, 0.02f * lipschitz), -side), side);
    int finite = disti_finite(f) && disti_finite(slope), away = !finite || !(slope > 1e-6f); /* there is no way on */
    float n[3] = {away ? 0.0f : g[0] / slope, away ? 0.0f : g[1] / slope, away ? 0.0f : g[2] / slope};
    if (cell->steps++ == 0) cell->empty = finite ? disti_certified_empty(field, size) : 3e38f;
    if (!away) disti_foot_move(field, cell->seed, n, -step);
    for (int i = 0; i < 3; i++) away |= !(fabs((double)cell->seed[i] - center[i]) <= 4.0 * half);
    /* no more: of a decoder f is nearly 0 in some places without a surface */
    cell->on = !away && size <= 0.002f * side * DISTI_MAX(slope, 0.25f) + disti_field_noise(field);
    for (int i = 0; i < 3 && cell->on; i++)
        cell->normal[i] = (signed char)(127.0f * n[i] + (n[i] < 0.0f ? -0.5f : 0.5f));
    cell->done = number < DISTI_FOOT_LEAVES || (double)cell->empty >= 1.7321 * half || cell->on || away ||
                 cell->steps == DISTI_FOOT_NEWTON;
    cell->asked = !cell->done;
    return cell->asked;
}

/* Begins a look around from the nearest point so far, or from the center. 0: there was enough of it. */
static int disti_foot_look_begin(disti_foot_tree *tree, disti_foot *foot, const double from[3])
{
    double radius = (double)tree->field->radius, leaf = radius / 16.0, hope[3];
    int lost = foot->status != DIST_RAY_HIT;
    memcpy(foot->from, foot->x, sizeof foot->from);
    if (foot->looks == DISTI_FOOT_LOOKS || foot->steps + 24 > DISTI_FOOT_STEPS) return 0;
    for (int i = 0; i < 3; i++) hope[i] = (double)foot->hope[i];
    double reach = foot->sign > 0.0f ? (double)foot->radius + leaf : 1e300, way = disti_foot_way(foot, from);
    double needed = way - reach;
    foot->tried = foot->found ? disti_foot_gain(foot, from, way, hope) + foot->slide : 1e300;
    foot->hoped = lost ? -1e300 : DISTI_MAX(needed, 0.0);
    foot->wanted = lost ? -1e300 : DISTI_MAX(needed, 1e-3 * radius);
    foot->looks++;
    foot->found = 0;
    if (!lost && (double)(foot->distance - foot->least) < foot->wanted) return 0;
    if (!(foot->tried > foot->hoped)) return 0; /* what is left is farther than what was found since */
    if (!tree->used) memset(tree->cells, 0, DISTI_FOOT_CELLS * sizeof *tree->cells);
    tree->used = foot->cell = 1;
    return 1;
}

/* Notes the seed of a leaf if it may lead the nearest, but for those at what is nearest already or has been tried: a
   slide along its plane, of two thirds of a leaf's half side (chosen), brings it nearer by that times the sine of the
   angle to p. */
static void disti_foot_note(const dist_field *field, disti_foot *foot, const double from[3], double way,
                            const disti_foot_cell *cell)
{
    double at[3], d[3], n[3], radius = (double)field->radius, apart = 0.0;
    for (int i = 0; i < 3; i++) {
        at[i] = (double)cell->seed[i];
        d[i] = (double)foot->p[i] - at[i];
        n[i] = (double)cell->normal[i];
        apart = DISTI_MAX(apart, fabs(at[i] - from[i]));
    }
    double along = disti_dot(d, n), squares = DISTI_MAX(disti_dot(d, d) * disti_dot(n, n), 1e-300);
    double slide = radius / 24.0 * sqrt(DISTI_MAX(1.0 - along * along / squares, 0.0));
    double gain = disti_foot_gain(foot, from, way, at);
    if (gain < foot->wanted && apart < 0.13 * radius) return;
    /* a little less than the last: in registers wider than a double that one is not itself */
    if (!(gain + slide > foot->hoped && gain + slide < foot->tried - 1e-9 * radius)) return;
    foot->hoped = gain + slide;
    foot->slide = slide;
    foot->found = 1;
    memcpy(foot->hope, cell->seed, sizeof foot->hope);
}

/* Goes on with a look around, or begins one, as far as the first cell that is not known yet; of those after it some
   are asked for where there is room. 1: that one is waited for, or a sample is wanted at x: of what was found, or else
   of a pull, or where it set out from, if it has not found the surface yet. */
static int disti_foot_look(disti_foot_tree *tree, disti_foot *foot)
{
    const dist_field *field = tree->field;
    const float *at = foot->status == DIST_RAY_HIT ? foot->best : field->center;
    const double from[3] = {(double)at[0], (double)at[1], (double)at[2]};
    if (foot->cell == 0 && !disti_foot_look_begin(tree, foot, from)) foot->found = 0;
    double center[3], half = disti_foot_cube(field, foot->cell, center), way = disti_foot_way(foot, from);
    int number = foot->cell, ahead = DISTI_FOOT_AHEAD;
    foot->cell = 0;
    for (int inner; number > 0; number = disti_foot_next(foot, number, inner, center, &half)) {
        disti_foot_cell *cell = &tree->cells[number];
        double d[3] = {center[0] - from[0], center[1] - from[1], center[2] - from[2]};
        if (foot->cell > 0 && (tree->count >= tree->spare || ahead-- == 0)) return 1;
        inner = 0;
        if (!disti_foot_promising(field, foot, from, way, center, half)) continue;
        if (number < DISTI_FOOT_LEAVES && foot->status == DIST_RAY_HIT && disti_dot(d, d) < 3.0 * half * half) {
            inner = 1; /* it is not empty */
            continue;
        }
        if (!cell->done && !cell->asked) disti_foot_ask(tree, number, center, half);
        if (!cell->done && foot->cell == 0) foot->cell = number;
        if (!cell->done || (double)cell->empty >= 1.7321 * half) continue;
        inner = number < DISTI_FOOT_LEAVES;
        if (cell->on && foot->cell == 0) disti_foot_note(field, foot, from, way, cell);
    }
    if (foot->cell > 0) return 1;
    foot->begun = foot->steps;
    if (!foot->found && foot->status == DIST_RAY_HIT)
        return !foot->settled && disti_foot_pull(field, foot, field->radius);
    memcpy(foot->x, foot->found ? foot->hope : foot->from, sizeof foot->x);
    if (!foot->found) return 1;
    foot->damping = foot->relax = 1.0f;
    foot->f = 0.0f;
    foot->slides = foot->landed = foot->sides = 0;
    return 1;
}

/* Of a foot without a surface point: notes the sides of it. 1: it goes to and fro in a thin solid, so it bisects. */
static int disti_foot_bisects(const dist_field *field, disti_foot *foot, float f, const float *n, int since)
{
    memcpy(f > 0.0f ? foot->best : foot->normal, foot->x, sizeof foot->x);
    foot->sides |= (unsigned char)(f > 0.0f ? 1 : 2);
    if (foot->sides < 2 || since < DISTI_FOOT_TURN / 2) return 0;
    if (foot->sides == 2) {
        memcpy(foot->best, foot->x, sizeof foot->x);
        disti_foot_move(field, foot->best, n, 2.0f * field->radius);
        foot->sides = 3;
    }
    for (int i = 0; i < 3; i++) foot->x[i] = 0.5f * (foot->best[i] + foot->normal[i]);
    return 1;
}

/* How far off the surface is at the least by what was looked at: of a sphere, little more than its radius. */
static float disti_foot_least(const dist_field *field, const disti_foot *foot)
{
    return foot->sign > 0.0f ? DISTI_MIN(foot->distance, foot->radius + field->radius / 16.0f) : foot->distance;
}

/* One sample f with gradient g at x. 1: another one is wanted at the new x. */
static int disti_foot_advance(disti_foot_tree *tree, disti_foot *foot, float f, const float *g)
{
    const dist_field *field = tree->field;
    float lipschitz = field->lipschitz > 0.0f ? field->lipschitz : 1.0f, size = f < 0.0f ? -f : f;
    float slope = disti_length(g[0], g[1], g[2]), n[3];
    if (!disti_finite(f) || !disti_finite(slope)) {
        foot->status = DIST_RAY_NOT_FINITE;
        return 0;
    }
    for (int i = 0; i < 3; i++) n[i] = slope > 1e-6f ? g[i] / slope : foot->p[i] - field->center[i];
    if (!(slope > 1e-6f)) { /* no direction: past the center, or any */
        float length = disti_length(n[0], n[1], n[2]);
        for (int i = 0; i < 3; i++) n[i] = length > 1e-6f * field->radius ? n[i] / length : i == 0 ? 1.0f : 0.0f;
    }
    if (foot->steps++ == 0) {
        float asked = f > 0.0f || foot->away <= 0.0f ? size : 0.0f;
        const float clear[3] = {foot->away, disti_certified_empty(field, asked), 0.0f};
        foot->sign = f < 0.0f && foot->away <= 0.0f ? -1.0f : 1.0f;
        foot->least = disti_foot_length(clear);
        if (foot->sign > 0.0f && foot->radius < 3e38f && foot->least >= foot->radius) {
            foot->status = DIST_RAY_MISS;
            foot->distance = foot->least;
            return 0;
        }
    }
    int on = size <= (1.5e-6f * field->radius + disti_field_noise(field)) * DISTI_MAX(slope, 0.25f);
    float gain = on ? disti_foot_arrive(foot, n) : 0.0f;
    float exact = 2e-5f * DISTI_MIN(foot->least, field->radius) + 2e-6f * field->radius;
    if (on) foot->landed = 1;
    if (on && foot->distance <= foot->least + exact) return 0;
    if (foot->steps >= DISTI_FOOT_STEPS) return 0;
    int since = foot->steps - foot->begun;
    foot->settled = 0;
    if (since < DISTI_FOOT_SLIDES && foot->landed && !foot->pulled && slope > (on ? 0.1f : 0.5f) * lipschitz &&
        (on || size < 0.02f * field->radius)) {
        if (disti_foot_slide(field, foot, n, f / slope, on)) return 1;
        foot->settled = gain > -1e-5f * field->radius;
    }
    int hit = foot->status == DIST_RAY_HIT; /* then a crease off the surface is not to hold it */
    if (on || (hit && since >= DISTI_FOOT_SLIDES + 8))
        return foot->pulled ? disti_foot_pull(field, foot, gain) : disti_foot_look(tree, foot);
    if (!hit && since >= DISTI_FOOT_TURN && foot->looks < DISTI_FOOT_LOOKS) return disti_foot_look(tree, foot);
    if (!hit && disti_foot_bisects(field, foot, f, n, since)) return 1;
    if (f * foot->f < 0.0f && size > 0.5f * (foot->f < 0.0f ? -foot->f : foot->f)) foot->damping *= 0.5f;
    foot->f = f;
    double flat = (double)size / (0.02 * (double)field->radius); /* where f is small, too: a whole step of Newton's */
    double step = (double)foot->damping * (double)f /
                  DISTI_MAX((double)slope, DISTI_MIN(0.5 * (double)lipschitz, flat));
    double most = 4.0 * (double)field->radius; /* it comes back to the sphere from any farther, too */
    disti_foot_move(field, foot->x, n, (float)-DISTI_MIN(DISTI_MAX(step, -most), most));
    return 1;
}

typedef struct disti_foot_job {
    dist_context *ctx;
    const dist_field *field;
    size_t n, stride; /* floats a point: 3, or 4 with a sphere's radius */
    const float *points;
    float *closest, *distance;
    unsigned char *status;
    dist_contact *contacts;
} disti_foot_job;

/* Sets out from p in the field's space; what is no nearer than radius is not wanted. 0: it is done already. */
static int disti_foot_begin(const dist_field *field, const float *p, float radius, disti_foot *foot)
{
    const float zero[3] = {0.0f, 0.0f, 0.0f};
    memset(foot, 0, sizeof *foot);
    memcpy(foot->p, p, sizeof foot->p);
    memcpy(foot->x, p, sizeof foot->x);
    foot->distance = 3e38f;
    foot->radius = radius;
    foot->damping = foot->relax = foot->sign = 1.0f;
    foot->share = 0.5f;
    foot->first = -1;
    foot->clear = 3e38f;
    foot->status = DIST_RAY_NOT_FINITE;
    if (!disti_finite_all(3, p) || !disti_finite(radius)) return 0;
    foot->away = disti_foot_move(field, foot->x, zero, 0.0f);
    int limited = radius < 3e38f;
    float clear[3] = {foot->away, field->cache && limited ? disti_cache_clear(field->cache, foot->x) : 0.0f, 0.0f};
    float least = disti_foot_length(clear);
    int clear_of = limited && least > 0.0f && least >= radius;
    foot->status = (unsigned char)(clear_of ? DIST_RAY_MISS : DIST_RAY_UNRESOLVED);
    if (clear_of) foot->distance = least;
    return !clear_of;
}

/* Goes on until the `active` ones that bench->index lists have arrived. Returns how often f was asked. Where f is the
   faster the more points it gets, cells that feet come to next go with those that they wait for, as long as there are
   fewer than DISTI_FOOT_BLOCK points. No more than DISTI_FEET in all: `active` never grows. */
static size_t disti_foot_rounds(const dist_field *field, int worker, const disti_bench *bench, disti_foot *feet,
                                float *gradient, size_t active)
{
    size_t asked = 0;
    disti_foot_cell *cells = (disti_foot_cell *)(void *)(gradient + 3 * DISTI_FEET);
    disti_foot_tree tree = {field, cells, (int *)(void *)(cells + DISTI_FOOT_CELLS), 0, 0, 0};
    int blocks = field->fused_fn || field->many; /* a net takes blocks of points */
    while (active > 0) {
        size_t kept = 0, asks = 0, told = 0, of_cells = (size_t)tree.count;
        for (size_t i = 0; i < of_cells; i++, asks++)
            memcpy(bench->points + 3 * asks, cells[tree.asked[i]].seed, 3 * sizeof(float));
        for (size_t i = 0; i < active; i++) {
            const disti_foot *foot = &feet[bench->index[i]];
            if (foot->cell == 0) memcpy(bench->points + 3 * asks++, foot->x, sizeof foot->x);
        }
        field->eval_fn(field->user, worker, asks, bench->points, bench->sdf, gradient);
        tree.count = 0;
        for (size_t i = 0; i < of_cells; i++, told++)
            if (disti_foot_told(&tree, tree.asked[i], bench->sdf[told], gradient + 3 * told))
                tree.asked[tree.count++] = tree.asked[i];
        size_t own = asks - of_cells;
        tree.spare = blocks && active + DISTI_FOOT_BLOCK <= DISTI_FEET && own < DISTI_FOOT_BLOCK
                         ? DISTI_FOOT_BLOCK - (int)own : 0;
        for (size_t i = 0; i < active; i++) {
            disti_foot *foot = &feet[bench->index[i]];
            size_t k = told;
            if (foot->cell == 0) told++;
            if (foot->cell > 0 ? disti_foot_look(&tree, foot)
                               : disti_foot_advance(&tree, foot, bench->sdf[k], gradient + 3 * k))
                bench->index[kept++] = bench->index[i];
        }
        asked += asks;
        active = kept;
    }
    return asked;
}

/* Scenes. f is a bound of the distance between an instance's sphere and a fifth of its radius off the surface, falls
   outward there, and does not tell which of two instances is nearer. So points go to each instance in its own space,
   first to the one whose sphere is nearest (the passes), then to those whose spheres are nearer than what was found.
   What is found within another instance is no surface of the scene; there, where instances overlap, f itself leads. */
enum { DISTI_TOUR_CHOOSE, DISTI_TOUR_FIRST, DISTI_TOUR_REST };
enum { DISTI_DOUBT_WITHIN = 1, DISTI_DOUBT_FINITE = 2, DISTI_DOUBT_FOUND = 4 };

typedef struct disti_foot_tour {
    const dist_field *field;
    const disti_bench *bench;
    size_t n;
    disti_foot *feet, *others; /* of the scene, and those in an instance's space */
    float *gradient;
    int worker;
    int leaves, leaf; /* instances that are no scenes, and which of them comes next */
    int pass;
} disti_foot_tour;

/* Of a foot, how near something must be to be wanted, 0: only what holds it; below 0: nothing is. */
static float disti_foot_wants(const disti_foot *foot)
{
    if (foot->status == DIST_RAY_UNRESOLVED) return foot->radius;
    if (foot->status != DIST_RAY_HIT || (foot->sign < 0.0f && !(foot->doubt & DISTI_DOUBT_WITHIN))) return -1.0f;
    float least = DISTI_MIN(foot->distance, foot->radius);
    return least > 0.0f ? least : -1.0f;
}

/* Lists the feet that go into a sphere that holds the next so many leaves. */
static size_t disti_foot_list(disti_foot_tour *tour, const double center[3], double radius, int leaves, int inner)
{
    size_t count = 0;
    for (size_t i = 0; i < tour->n; i++) {
        disti_foot *foot = &tour->feet[i];
        float within = disti_foot_wants(foot);
        double d[3];
        if (within < 0.0f) continue;
        for (int k = 0; k < 3; k++) d[k] = (double)foot->p[k] - center[k];
        float away = (float)DISTI_MIN(sqrt(disti_dot(d, d)) - radius, 3e38);
        int first = foot->first >= tour->leaf && foot->first < tour->leaf + leaves;
        if (tour->pass == DISTI_TOUR_CHOOSE ? !(away < foot->clear)
                                            : tour->pass == DISTI_TOUR_FIRST ? !first : first && !inner) continue;
        if (tour->pass == DISTI_TOUR_CHOOSE && !inner) {
            foot->first = tour->leaf;
            foot->clear = away;
        } else if (tour->pass != DISTI_TOUR_CHOOSE && !(away < within)) {
            foot->clear = DISTI_MIN(foot->clear, away);
            continue;
        }
        tour->bench->index[count++] = (int)i;
    }
    return count;
}

/* The listed ones go to an instance. Returns how often it was asked. */
static size_t disti_foot_visit(disti_foot_tour *tour, const dist_field *field, const disti_chain *chain, size_t count)
{
    const disti_bench *bench = tour->bench;
    const float within = -1e-4f * (float)chain->scale * field->radius - 2e-6f * tour->field->radius;
    size_t active = 0, found = 0;
    for (size_t i = 0; i < tour->n; i++) tour->others[i].status = DIST_RAY_SKIPPED;
    for (size_t j = 0; j < count; j++) {
        size_t i = (size_t)bench->index[j];
        float q[3], wants = disti_foot_wants(&tour->feet[i]);
        disti_chain_back(chain, tour->feet[i].p, q);
        wants = (float)DISTI_MIN((double)wants / chain->scale, 3e38);
        if (disti_foot_begin(field, q, wants, &tour->others[i])) bench->index[active++] = (int)i;
    }
    size_t asked = disti_foot_rounds(field, tour->worker, bench, tour->others, tour->gradient, active);
    for (size_t i = 0; i < tour->n; i++) {
        disti_foot *foot = &tour->feet[i], *other = &tour->others[i];
        if (other->status == DIST_RAY_SKIPPED) continue;
        if (other->status == DIST_RAY_NOT_FINITE) foot->doubt |= DISTI_DOUBT_FINITE;
        if (other->status == DIST_RAY_UNRESOLVED) foot->doubt |= DISTI_DOUBT_FOUND;
        if (other->status == DIST_RAY_MISS)
            foot->clear = DISTI_MIN(foot->clear, (float)((double)other->distance * chain->scale));
        if (other->sign < 0.0f) foot->sign = -1.0f;
        if (other->status != DIST_RAY_HIT) continue;
        if (other->distance > other->radius)
            foot->clear = DISTI_MIN(foot->clear, (float)((double)disti_foot_least(field, other) * chain->scale));
        double x[3];
        float d[3];
        disti_chain_point(chain, other->best, x);
        for (int k = 0; k < 3; k++) {
            bench->points[3 * found + (size_t)k] = (float)x[k];
            d[k] = foot->p[k] - (float)x[k];
        }
        other->distance = disti_foot_length(d);
        if (foot->status != DIST_RAY_HIT || other->distance < foot->distance) bench->index[found++] = (int)i;
    }
    if (found > 0 && tour->leaves > 1)
        tour->field->eval_fn(tour->field->user, tour->worker, found, bench->points, bench->sdf, NULL);
    for (size_t j = 0; j < found; j++) {
        size_t i = (size_t)bench->index[j];
        disti_foot *foot = &tour->feet[i];
        const double n[3] = {(double)tour->others[i].normal[0], (double)tour->others[i].normal[1],
                             (double)tour->others[i].normal[2]};
        double turned[3];
        if (tour->leaves > 1 && !(bench->sdf[j] > within)) {
            foot->doubt |= DISTI_DOUBT_WITHIN;
            continue;
        }
        disti_rotate(chain->rotation, n, turned);
        for (int k = 0; k < 3; k++) foot->normal[k] = (float)turned[k];
        memcpy(foot->best, bench->points + 3 * j, sizeof foot->best);
        foot->distance = tour->others[i].distance;
        foot->status = DIST_RAY_HIT;
    }
    return asked;
}

/* A pass over the instances of the scene and of those in it. Returns how often they were asked. */
static size_t disti_foot_pass(disti_foot_tour *tour, const dist_scene *scene, const disti_chain *chain)
{
    size_t asked = 0;
    disti_scene_work w;
    for (int k = 0; k < scene->count; k++) {
        const dist_field *field = &scene->placed[k].field;
        int inner = field->eval_fn == disti_scene_eval, leaves = disti_scene_leaves(field);
        disti_chain next = disti_chain_on(chain, &scene->placed[k]);
        double center[3];
        disti_chain_point(&next, field->center, center);
        size_t count = disti_foot_list(tour, center, next.scale * (double)field->radius, leaves, inner);
        if (count > 0 && inner) {
            asked += disti_foot_pass(tour, (const dist_scene *)field->user, &next);
            continue;
        }
        if (count > 0 && tour->pass != DISTI_TOUR_CHOOSE) asked += disti_foot_visit(tour, field, &next, count);
        tour->leaf += leaves;
    }
    disti_scene_layout(scene, disti_scene_scratch(scene, tour->worker), &w);
    *w.queries += asked;
    return asked;
}

/* The feet of a scene that f itself leads, by what they found so far. */
static void disti_foot_led(disti_foot_tour *tour)
{
    size_t active = 0;
    for (size_t i = 0; i < tour->n; i++) {
        disti_foot *foot = &tour->feet[i], *other = &tour->others[i];
        int lost = foot->status == DIST_RAY_UNRESOLVED && foot->doubt & DISTI_DOUBT_FOUND;
        other->status = DIST_RAY_SKIPPED;
        if (!lost && !(foot->doubt & DISTI_DOUBT_WITHIN)) continue;
        if (disti_foot_begin(tour->field, foot->p, foot->radius, other)) tour->bench->index[active++] = (int)i;
    }
    disti_foot_rounds(tour->field, tour->worker, tour->bench, tour->others, tour->gradient, active);
    for (size_t i = 0; i < tour->n; i++) {
        disti_foot *foot = &tour->feet[i], *other = &tour->others[i];
        other->clear = foot->clear;
        if (other->status == DIST_RAY_HIT && (foot->status != DIST_RAY_HIT || other->distance < foot->distance))
            *foot = *other;
    }
}

static void disti_foot_scene(disti_foot_tour *tour)
{
    const disti_chain here = {1.0, {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0}, {0.0, 0.0, 0.0}};
    const dist_scene *scene = (const dist_scene *)tour->field->user;
    for (tour->pass = DISTI_TOUR_CHOOSE; tour->pass <= DISTI_TOUR_REST; tour->pass++) {
        tour->leaf = 0;
        disti_foot_pass(tour, scene, &here);
        for (size_t i = 0; i < tour->n && tour->pass == DISTI_TOUR_CHOOSE; i++) tour->feet[i].clear = 3e38f;
    }
    disti_foot_led(tour);
    for (size_t i = 0; i < tour->n; i++) {
        disti_foot *foot = &tour->feet[i];
        if (foot->status == DIST_RAY_HIT && foot->sign > 0.0f && foot->distance >= foot->radius)
            foot->distance = DISTI_MIN(foot->distance, foot->clear);
        if (foot->status != DIST_RAY_UNRESOLVED) continue;
        if (foot->doubt & DISTI_DOUBT_FINITE) foot->status = DIST_RAY_NOT_FINITE;
        else if (foot->doubt == 0 && foot->radius < 3e38f) {
            foot->status = DIST_RAY_MISS;
            foot->distance = foot->clear;
        }
    }
}

static void disti_foot_task(void *arg, int index, int worker)
{
    const disti_foot_job *job = (const disti_foot_job *)arg;
    const dist_field *field = job->field;
    const float zero[3] = {0.0f, 0.0f, 0.0f};
    disti_bench bench;
    disti_bench_init(job->ctx, worker, &bench);
    DIST_ASSERT(DISTI_FEET * (2 * sizeof(disti_foot) + 3 * sizeof(float)) +
                DISTI_FOOT_CELLS * sizeof(disti_foot_cell) + DISTI_FEET * sizeof(int) <= DISTI_REST_BYTES);
    disti_foot *feet = (disti_foot *)(void *)bench.rest, *others = feet + DISTI_FEET;
    float *gradient = (float *)(void *)(others + DISTI_FEET);
    size_t first = (size_t)index * DISTI_FEET, n = DISTI_MIN((size_t)DISTI_FEET, job->n - first), active = 0;
    for (size_t i = 0; i < n; i++) {
        const float *p = job->points + job->stride * (first + i);
        if (disti_foot_begin(field, p, job->contacts ? p[3] : 3e38f, &feet[i])) bench.index[active++] = (int)i;
    }
    if (field->eval_fn == disti_scene_eval) {
        disti_foot_tour tour = {field, &bench, n, feet, others, gradient, worker, disti_scene_leaves(field), 0, 0};
        disti_foot_scene(&tour);
    } else {
        disti_foot_rounds(field, worker, &bench, feet, gradient, active);
    }
    for (size_t i = 0; i < n; i++) {
        disti_foot *foot = &feet[i];
        float d[3] = {foot->p[0] - foot->x[0], foot->p[1] - foot->x[1], foot->p[2] - foot->x[2]};
        if (foot->status != DIST_RAY_HIT) memcpy(foot->best, foot->x, sizeof foot->best);
        if (foot->status == DIST_RAY_UNRESOLVED) foot->distance = disti_foot_length(d);
        if (job->contacts) {
            dist_contact *contact = &job->contacts[first + i];
            contact->depth = foot->radius - foot->sign * foot->distance;
            if (foot->status == DIST_RAY_HIT && !(contact->depth > 0.0f)) {
                contact->depth = foot->radius - disti_foot_least(field, foot);
                foot->status = DIST_RAY_MISS;
            }
            if (foot->status == DIST_RAY_NOT_FINITE) contact->depth = 0.0f;
            memcpy(contact->normal, foot->status == DIST_RAY_HIT ? foot->normal : zero, sizeof contact->normal);
            double away[3];
            for (size_t k = 0; k < 3; k++) away[k] = (double)foot->p[k] - (double)foot->best[k];
            int far = foot->status == DIST_RAY_HIT && foot->distance > 1e-3f * field->radius && disti_normalize(away);
            for (size_t k = 0; k < 3 && far; k++) /* right at an edge, too */
                contact->normal[k] = foot->sign * (float)away[k];
            memcpy(contact->point, foot->best, sizeof contact->point);
            contact->status = foot->status;
            continue;
        }
        memcpy(job->closest + 3 * (first + i), foot->best, sizeof foot->best);
        if (job->distance) job->distance[first + i] = foot->sign * foot->distance;
        if (job->status) job->status[first + i] = foot->status;
    }
}

/* Whether the caches of a scene's instances, which feet use, show what is still so. */
static dist_status disti_foot_caches(dist_context *ctx, const dist_scene *scene, const char *function)
{
    dist_status status = DIST_OK;
    unsigned char text[96];
    disti_writer w = {text, 0};
    disti_put_text(&w, function);
    disti_put(&w, ": an instance", sizeof ": an instance");
    for (int i = 0; i < scene->count && status == DIST_OK; i++) {
        const dist_field *field = &scene->placed[i].field;
        if (field->cache) status = disti_cache_check(ctx, field, (const char *)text);
        if (status == DIST_OK && field->eval_fn == disti_scene_eval)
            status = disti_foot_caches(ctx, (const dist_scene *)field->user, function);
    }
    return status;
}

static dist_status disti_foot_run(disti_foot_job *job, const char *function, const void *out)
{
    dist_status status = disti_enter(job->ctx, function);
    if (status == DIST_OK) status = disti_field_check(job->ctx, job->field, function);
    if (status == DIST_OK && job->field->eval_fn == disti_scene_eval)
        status = disti_foot_caches(job->ctx, (const dist_scene *)job->field->user, function);
    if (status == DIST_OK) status = disti_count_check(job->ctx, job->n, function);
    if (status != DIST_OK) return status;
    if (job->n > 0 && (!job->points || !out))
        return disti_refuse(job->ctx, !out            ? "%s: the array for the answers is NULL"
                                      : job->contacts ? "%s: spheres is NULL"
                                                      : "%s: points is NULL", function);
    for (size_t i = 0; i < job->n && job->contacts; i++)
        if (disti_finite(job->points[4 * i + 3]) && job->points[4 * i + 3] < 0.0f)
            return disti_fail(job->ctx, DIST_BAD_ARGUMENT, "%s: the radius of sphere %d is %d, must be 0 or positive",
                              function, (double)i, (double)job->points[4 * i + 3]);
    disti_run(job->ctx, (int)((job->n + DISTI_FEET - 1) / DISTI_FEET), disti_foot_task, job);
    return DIST_OK;
}

DIST_API dist_status dist_field_closest_point(dist_context *ctx, const dist_field *field, size_t n,
                                              const float *points, float *closest, float *distance,
                                              unsigned char *status)
{
    disti_foot_job job = {ctx, field, n, 3, points, closest, distance, status, NULL};
    return disti_foot_run(&job, "dist_field_closest_point", closest);
}

DIST_API dist_status dist_field_collide(dist_context *ctx, const dist_field *field, size_t n, const float *spheres,
                                        dist_contact *contacts)
{
    disti_foot_job job = {ctx, field, n, 4, spheres, NULL, NULL, NULL, contacts};
    return disti_foot_run(&job, "dist_field_collide", contacts);
}

/* Half a pixel's width at unit distance: cos^2 / (2 f), with the larger of the focal lengths. */
static double disti_view_footprint(const disti_view *view, double cosine)
{
    double f = DISTI_MAX(fabs(view->fx), fabs(view->fy));
    return 0.5 * cosine * cosine / f;
}

/* A tile of the picture. Where the picture goes on, one more column and row are traced (never written), so that every
   pixel has neighbors on both sides to be predicted from. */
typedef struct disti_tile {
    const disti_view *view;
    const size_t *list; /* pixels of the rays, which then stand in one row; NULL: a rectangle */
    int x, y, width, height; /* traced: at most DISTI_TILE + 1 each */
    int own_width, own_height; /* written */
    int lattice; /* pixels between those that are marched before the others are predicted, a power of 2 */
    int cheap, normals; /* 1: queries cost less than bookkeeping; grad f is wanted at hits */
    int lazy; /* 1: only the rays that the cones leave are made; of the others no more is known than that they miss */
} disti_tile;

static size_t disti_tile_pixel(const disti_tile *tile, int i)
{
    if (tile->list) return tile->list[i];
    return (size_t)(tile->y + i / tile->width) * (size_t)tile->view->width + (size_t)(tile->x + i % tile->width);
}

/* A pixel that nobody asked for. */
static void disti_ray_skip(disti_ray *ray)
{
    memset(ray, 0, sizeof *ray);
    ray->fbest = 3e38f;
    ray->status = DIST_RAY_SKIPPED; /* mode is DISTI_DONE, and the sphere is not met: enter = leave */
}

/* A ray that misses; where no more is wanted of it, it is not even made. */
static void disti_ray_close(disti_ray *ray)
{
    ray->mode = DISTI_DONE;
    ray->status = DIST_RAY_MISS;
}

/* Makes the rays of pixels x0..x1-1, y0..y1-1 of the tile, as disti_pixel_ray does. */
static void disti_tile_rays(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench, int x0,
                            int y0, int x1, int y1)
{
    const disti_view *view = tile->view;
    const double *m = view->rotation;
    const unsigned char *pixels = tracer->how.pixels;
    double c[3], per_pixel = disti_view_footprint(view, 1.0);
    for (int i = 0; i < 3; i++) c[i] = view->center[i] - (double)tracer->field->center[i];
    for (int y = y0; y < y1; y++) {
        double v = ((double)(tile->y + y) + view->first - view->cy) / view->fy;
        double skewed = view->cx + view->skew * v - view->first;
        double row[3] = {m[3] * v + m[6], m[4] * v + m[7], m[5] * v + m[8]};
        disti_ray *ray = bench->rays + y * tile->width + x0;
        memset(ray, 0, (size_t)(x1 - x0) * sizeof *ray);
        for (int x = tile->x + x0; x < tile->x + x1; x++, ray++) {
            if (pixels && !pixels[(size_t)(tile->y + y) * (size_t)view->width + (size_t)x]) {
                disti_ray_skip(ray);
                continue;
            }
            double u = ((double)x - skewed) / view->fx, cosine = 1.0 / sqrt(u * u + v * v + 1.0);
            disti_ray_place(tracer->field, c[0], c[1], c[2], (m[0] * u + row[0]) * cosine,
                            (m[1] * u + row[1]) * cosine, (m[2] * u + row[2]) * cosine, per_pixel * cosine * cosine,
                            ray);
            ray->cosine = (float)cosine;
        }
    }
}

/* Cones: a block of pixels marches as one while the sphere that f / L proves empty is wider than the block's cone
   there; then its children start where it stopped. Safe for anything, however thin, under the Lipschitz bound: every
   point of every ray of the block before the stop lies in one of the empty spheres. Outside the bounding sphere f says
   nothing: where the axis passes by at a distance o, f is asked for at the point of the sphere nearest to it. If the
   ball of radius E about that is empty, so is one of radius sqrt(o^2 + E^2) about the axis: what of the bounding sphere
   lies nearer than that to the axis's point lies nearer than E to the sphere's, behind the plane that touches there. */
typedef struct disti_cone {
    float origin[3], direction[3]; /* of the axis, as of a ray */
    double base;
    double leave; /* no ray of the block is in the bounding sphere beyond, measured from the camera */
    double t;
    double chord, cosine, sine; /* of the cone's half angle: chord = 2 sin(angle / 2) */
    int x, y;     /* first pixel, within the tile */
    int size;
    int tile;     /* which, where cones of several are asked for together */
    int state;    /* DISTI_CONE_* */
    int steps;
    float f;      /* last sample */
    float out;    /* how far outside the bounding sphere the axis is there */
    double least_t; /* where the block's axes had the least f, and that f */
    float least_f, least_out;
} disti_cone;

enum {
    DISTI_CONE_FIRST = 32,
    DISTI_CONE_WARM = 128, /* the first of a warm start: all of a tile */
    DISTI_CONE_LEAF = 4,
    DISTI_CONE_RAYS = 4, /* fewer march by themselves */
    DISTI_CONE_OUTLINE = 2, /* where the outline passes, if balls are not worth it */
    DISTI_CONES_MOST = 1 + 4 + 9 + 36 + 121 + 484 + 1936 /* down to 2 pixels, in a tile of 88 */
};

enum { DISTI_CONE_THROUGH, DISTI_CONE_BLOCKED, DISTI_CONE_SPLIT, DISTI_CONE_MARCHES };

/* One past the last pixel of a block that starts at `first`: the extra column goes with the last block. */
static int disti_block_end(int first, int size, int own, int traced)
{
    return first + size >= own ? traced : first + size;
}

/* Whether so few of the block's pixels are asked for that a cone for them is not worth it. */
static int disti_cone_few(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench,
                          const disti_cone *cone, int x1, int y1)
{
    int rays = (x1 - cone->x) * (y1 - cone->y), done = 0;
    for (int y = cone->y; tracer->how.pixels && y < y1; y++)
        for (int x = cone->x; x < x1; x++) done += bench->rays[y * tile->width + x].mode == DISTI_DONE;
    return rays - done < DISTI_CONE_RAYS;
}

/* Axis, width and state of a cone of which x, y, size and t are set. Of all rays of the cone the one nearest to the
   center of the bounding sphere, at the angle to it of the axis less the half angle, enters that first and leaves it
   last; all others lie between. */
static void disti_cone_init(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench,
                            disti_cone *cone)
{
    const disti_view *view = tile->view;
    const dist_field *field = tracer->field;
    int x1 = disti_block_end(cone->x, cone->size, tile->own_width, tile->width) - 1;
    int y1 = disti_block_end(cone->y, cone->size, tile->own_height, tile->height) - 1;
    double axis[3], corner[3], world[3], o[3], widest = 0.0, radius = (double)field->radius;
    disti_view_direction(view, tile->x + 0.5 * (cone->x + x1), tile->y + 0.5 * (cone->y + y1), axis);
    for (int i = 0; i < 4; i++) {
        disti_view_direction(view, tile->x + (i & 1 ? x1 : cone->x), tile->y + (i & 2 ? y1 : cone->y), corner);
        double d[3] = {corner[0] - axis[0], corner[1] - axis[1], corner[2] - axis[2]};
        widest = DISTI_MAX(widest, disti_dot(d, d));
    }
    cone->chord = sqrt(widest);
    cone->cosine = 1.0 - 0.5 * widest; /* chord = 2 sin(angle / 2), so cos(angle) = 1 - chord^2 / 2 */
    cone->sine = sqrt(widest * DISTI_MAX(0.0, 1.0 - 0.25 * widest));
    disti_rotate_back(view->rotation, axis, world);
    for (int i = 0; i < 3; i++) o[i] = view->center[i] - (double)field->center[i];
    double along = cone->base = -disti_dot(o, world);
    for (int i = 0; i < 3; i++) {
        o[i] += along * world[i];
        cone->origin[i] = (float)(o[i] + (double)field->center[i]);
        cone->direction[i] = (float)world[i];
    }
    double off = sqrt(disti_dot(o, o)), near = off * cone->cosine - along * cone->sine;
    double ahead = near > 0.0 ? along * cone->cosine + off * cone->sine : sqrt(along * along + off * off);
    double half = near > 0.0 ? radius * radius - near * near : radius * radius;
    half = half > 0.0 ? sqrt(half) : -ahead;
    cone->t = DISTI_MAX(DISTI_MAX(cone->t, ahead - half), 0.0);
    cone->leave = ahead + half;
    cone->f = 3e38f; /* no sample */
    cone->state = !(cone->t < cone->leave)                                   ? DISTI_CONE_THROUGH
                  : disti_cone_few(tracer, tile, bench, cone, x1 + 1, y1 + 1) ? DISTI_CONE_BLOCKED
                                                                             : DISTI_CONE_MARCHES;
}

/* Where f is asked for a cone at cone->t. */
static void disti_cone_point(const dist_field *field, disti_cone *cone, float p[3])
{
    float s = (float)(cone->t - cone->base);
    double d[3], radius = (double)field->radius;
    for (int i = 0; i < 3; i++) {
        p[i] = cone->origin[i] + s * cone->direction[i];
        d[i] = (double)p[i] - (double)field->center[i];
    }
    double square = disti_dot(d, d), length = square > radius * radius ? sqrt(square) : radius;
    cone->out = (float)(length - radius);
    if (length <= radius) return;
    for (int i = 0; i < 3; i++) p[i] = (float)((double)field->center[i] + d[i] * (radius / length));
}

/* One sample for the cone, and the state that follows from it. */
static int disti_cone_advance(const disti_tracer *tracer, disti_cone *cone, float f)
{
    cone->f = f;
    if (!disti_finite(f) || ++cone->steps > 64) return DISTI_CONE_BLOCKED;
    /* on the plateau of a clamped field, where samples are equal, the one nearest to the center */
    int level = !(f > cone->least_f) && fabs(cone->t - cone->base) < fabs(cone->least_t - cone->base);
    int better = cone->out > 0.0f ? !(cone->least_f < 2e38f) : cone->least_out > 0.0f || f < cone->least_f || level;
    if (better) {
        cone->least_f = f;
        cone->least_t = cone->t;
        cone->least_out = cone->out;
    }
    float margin = tracer->epsilon > 0.0f ? tracer->epsilon : tracer->usual;
    double radius = (double)disti_empty(tracer, f - margin), out = (double)cone->out, wide = cone->t * cone->sine;
    if (out > 0.0) radius = sqrt(out * out + DISTI_MAX(radius, 0.0) * DISTI_MAX(radius, 0.0));
    if (radius < 1.05 * cone->t * cone->chord || radius <= wide) return DISTI_CONE_BLOCKED;
    double t = cone->t * cone->cosine + sqrt(radius * radius - wide * wide);
    if (t - cone->t < 1e-3 * (double)tracer->field->radius) return DISTI_CONE_BLOCKED;
    cone->t = t;
    return t < cone->leave ? DISTI_CONE_MARCHES : DISTI_CONE_THROUGH;
}

/* What a cone leaves: rays of a block that is through are misses; the others start at the block's stop, where f is
   at most the cone's sample plus the Lipschitz figure times how far they are from where that was taken. */
static void disti_cone_finish(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench,
                              disti_cone *cone)
{
    int x1 = disti_block_end(cone->x, cone->size, tile->own_width, tile->width);
    int y1 = disti_block_end(cone->y, cone->size, tile->own_height, tile->height);
    for (int y = cone->y; y < DISTI_MIN(cone->y + cone->size, tile->own_height); y += DISTI_LEAST_BLOCK) {
        for (int x = cone->x; x < DISTI_MIN(cone->x + cone->size, tile->own_width); x += DISTI_LEAST_BLOCK) {
            int block = y / DISTI_LEAST_BLOCK * DISTI_LEAST_ROW + x / DISTI_LEAST_BLOCK;
            disti_least *least = bench->least_of;
            int out = cone->least_out > 0.0f, had = least->out[block] > 0.0f;
            if (!(had && !out) && !(had == out && cone->least_f < least->f[block]) && least->f[block] < 2e38f) continue;
            least->f[block] = cone->least_f;
            least->t[block] = (float)cone->least_t;
            least->out[block] = cone->least_out;
        }
    }
    float axis[3], p[3];
    disti_cone_point(tracer->field, cone, axis);
    for (int y = cone->y; y < y1; y++) {
        for (int x = cone->x; x < x1; x++) {
            disti_ray *ray = &bench->rays[y * tile->width + x];
            if (ray->mode != DISTI_FIRST && ray->mode != DISTI_WAIT) continue;
            if (cone->state == DISTI_CONE_THROUGH || cone->t >= ray->base + (double)ray->leave) {
                disti_ray_close(ray);
                continue;
            }
            ray->start = ray->q = DISTI_MAX(ray->enter, (float)(cone->t - ray->base));
            disti_ray_point(ray, ray->start, p);
            float away = disti_length(p[0] - axis[0], p[1] - axis[1], p[2] - axis[2]);
            if (disti_finite(cone->f)) ray->guard = cone->f + tracer->lipschitz * away + 1e-3f * tracer->field->radius;
        }
    }
}

/* Adds a block's cone to those in bench->rest, and to the list where it marches. */
static void disti_cone_add(const disti_tracer *tracer, const disti_tile *tile, disti_bench *bench, int x, int y,
                           int size, const disti_cone *parent, size_t *listed)
{
    disti_cone *cone = (disti_cone *)(void *)bench->rest + bench->cones;
    memset(cone, 0, sizeof *cone);
    cone->x = x;
    cone->y = y;
    cone->size = size;
    cone->tile = parent ? parent->tile : 0;
    cone->t = parent ? parent->t : 0.0;
    cone->least_t = parent ? parent->least_t : 0.0;
    cone->least_f = parent ? parent->least_f : 3e38f;
    cone->least_out = parent ? parent->least_out : 0.0f;
    disti_cone_init(tracer, tile, bench, cone);
    if (cone->state == DISTI_CONE_MARCHES) bench->index[(*listed)++] = bench->cones;
    bench->cones++;
}

/* Adds the cones of a block's four quarters. */
static void disti_cone_split(const disti_tracer *tracer, const disti_tile *tile, disti_bench *bench, disti_cone *cone,
                             size_t *listed)
{
    int half = cone->size / 2;
    cone->state = DISTI_CONE_SPLIT;
    for (int k = 0; k < 4; k++) {
        int x = cone->x + (k & 1 ? half : 0), y = cone->y + (k & 2 ? half : 0);
        if (x < tile->own_width && y < tile->own_height)
            disti_cone_add(tracer, tile, bench, x, y, half, cone, listed);
    }
}

/* Marches the `active` cones listed in bench->index, and the parts that they fall into down to `leaf` pixels, all that
   are on their way in packed rounds. tile: that of cones whose `tile` is 0, and those that follow. */
static void disti_cone_rounds(const disti_tracer *tracer, int worker, const disti_tile *tile, disti_bench *bench,
                              size_t active, int leaf)
{
    disti_cone *cones = (disti_cone *)(void *)bench->rest;
    while (active > 0) {
        for (size_t i = 0; i < active; i++)
            disti_cone_point(tracer->field, &cones[bench->index[i]], bench->points + 3 * i);
        size_t asked = disti_query(tracer, worker, bench, active), all = active, kept = 0;
        bench->stats->cone_queries += asked;
        for (size_t i = 0; i < active; i++) { /* children go behind all others in the list */
            disti_cone *cone = &cones[bench->index[i]];
            cone->state = i < asked ? disti_cone_advance(tracer, cone, bench->sdf[i]) : DISTI_CONE_BLOCKED;
            if (cone->state == DISTI_CONE_MARCHES) bench->index[kept++] = bench->index[i];
            if (cone->state == DISTI_CONE_BLOCKED && i < asked && cone->size > leaf)
                disti_cone_split(tracer, tile + cone->tile, bench, cone, &all);
        }
        memmove(bench->index + kept, bench->index + active, (all - active) * sizeof(int));
        active = kept + all - active;
    }
}

/* Adds the tile's blocks of `first` pixels, or what is enough for all of it. */
static void disti_cones_first(const disti_tracer *tracer, const disti_tile *tile, disti_bench *bench, int first,
                              int leaf, size_t *listed)
{
    while (first > leaf && first / 2 >= DISTI_MAX(tile->own_width, tile->own_height)) first /= 2;
    for (int y = 0; y < tile->own_height; y += first)
        for (int x = 0; x < tile->own_width; x += first)
            disti_cone_add(tracer, tile, bench, x, y, first, NULL, listed);
}

/* Blocks of 32, 16, 8 and so on to `leaf` pixels. Returns how many are not seen to be empty. known: those that did
   not fall apart, if they have been asked for before, up to one of size 0. */
static int disti_cones(const disti_tracer *tracer, int worker, const disti_tile *tile, disti_bench *bench, int leaf,
                       const disti_cone *known)
{
    disti_cone *cones = (disti_cone *)(void *)bench->rest;
    size_t active = 0;
    int blocked = 0;
    DIST_ASSERT((size_t)DISTI_CONES_MOST * sizeof(disti_cone) <= (size_t)DISTI_REST_BYTES);
    if (!known) disti_cones_first(tracer, tile, bench, (int)DISTI_CONE_FIRST, leaf, &active);
    for (; known && known->size > 0; known++) cones[bench->cones++] = *known;
    disti_cone_rounds(tracer, worker, tile, bench, active, leaf);
    for (int i = 0; i < bench->cones; i++) blocked += cones[i].state == DISTI_CONE_BLOCKED;
    if (tile->lazy && blocked == 0) return 0;
    for (int i = 0; i < bench->cones; i++) {
        disti_cone *cone = &cones[i];
        int x1 = disti_block_end(cone->x, cone->size, tile->own_width, tile->width);
        int y1 = disti_block_end(cone->y, cone->size, tile->own_height, tile->height);
        if (cone->state == DISTI_CONE_SPLIT) continue;
        if (tile->lazy && cone->state == DISTI_CONE_BLOCKED)
            disti_tile_rays(tracer, tile, bench, cone->x, cone->y, x1, y1);
        for (int y = cone->y; tile->lazy && cone->state == DISTI_CONE_THROUGH && y < y1; y++)
            for (int x = cone->x; x < x1; x++) disti_ray_close(&bench->rays[y * tile->width + x]);
        if (!tile->lazy || cone->state == DISTI_CONE_BLOCKED) disti_cone_finish(tracer, tile, bench, cone);
    }
    return blocked;
}

/* Prediction between neighbors: every 8th pixel (of large pixels every 4th: disti_render_lattice) is marched, then the
   pixels half way between known ones, three times over. 1 / z is linear over a plane, so the distance is interpolated
   in it, from four collinear hits (-1, 9, 9, -1) / 16 where they are near each other, else from two; most pixels then
   need one query. Two checks keep what is in front from being missed: no prediction across a miss or a jump
   in depth; and f where the cones stopped must not be smaller than the predicted surface alone would make it, or
   something else is near. */
enum { DISTI_LATTICE = 8 };

/* Depth of the hit `shift` pixels along one axis; 0 where there is none. */
static float disti_depth_beside(const float *depth, int at, int end, int shift, int stride)
{
    return at + shift < 0 || at + shift >= end ? 0.0f : depth[shift * stride];
}

typedef struct disti_guess {
    float depth, slope;
    int quality; /* 3: by four hits alike, 2: good, 1: but the slope is anyone's guess, -1: beyond an edge, 0: none */
    float off;   /* how far it may be off by what the neighbors were; 0: unknown */
    float seen;  /* how far the neighbors' own predictions were off */
    float spread; /* of the neighbors' slopes, relative to their mean */
    float differ; /* of the cubics along the two axes */
    float sag;   /* how far the cubic is from the line */
} disti_guess;

/* What neighbors at (at - h, beside) and (at + h, beside) say of how far a cubic is off here. Each was predicted from
   pixels farther apart, at its `level`, the lowest bit of its coordinates: on a smooth surface the error grows with the
   fourth power of that distance, at a crease amid the four with the distance itself, so theirs counts h / level times.
   For pixels of the lattice, which were not predicted, the other neighbor speaks. */
static void disti_guess_off(disti_guess *guess, const disti_ray *before, const disti_ray *behind, int lattice, int at,
                            int beside, int h)
{
    int level1 = ((at - h) | beside) & (lattice - 1), level2 = ((at + h) | beside) & (lattice - 1);
    float off1 = before->off, off2 = behind->off;
    if (before->kept || behind->kept) { /* warm: predicted by the last picture, or from next to it */
        level1 = level2 = h;
    } else {
        if (level1 == 0) off1 = off2, level1 = level2;
        if (level2 == 0) off2 = off1, level2 = level1;
    }
    if (!(off1 > 0.0f && off2 > 0.0f) || level1 == 0) return;
    guess->seen = DISTI_MAX(off1, off2);
    guess->off = (float)h * DISTI_MAX(off1 / (float)(level1 & -level1), off2 / (float)(level2 & -level2));
}

/* Prediction along one axis of the picture from the hits at -3 h, -h, h, 3 h. Across an edge, where the hits at -h and
   h are a step apart, it is the farther surface, in case that the ray passes the nearer. */
static void disti_predict_axis(const disti_tracer *tracer, const disti_ray *ray, const float *depth, int lattice,
                               int at, int beside, int end, int h, int stride, disti_guess *guess)
{
    memset(guess, 0, sizeof *guess);
    float near = 0.1f * tracer->field->radius;
    float z1 = disti_depth_beside(depth, at, end, -h, stride), z2 = disti_depth_beside(depth, at, end, h, stride);
    if (!(z1 > 0.0f && z2 > 0.0f)) return;
    float a = disti_depth_beside(depth, at, end, -3 * h, stride);
    float b = disti_depth_beside(depth, at, end, 3 * h, stride);
    int near_a = a > 0.0f && a - z1 < near && z1 - a < near, near_b = b > 0.0f && b - z2 < near && z2 - b < near;
    float slope1 = ray[-h * stride].slope, slope2 = ray[h * stride].slope;
    float flatter = DISTI_MAX(slope1, slope2), mean = 0.5f * (slope1 + slope2), gap = z1 < z2 ? z2 - z1 : z1 - z2;
    if (!(flatter < 0.0f)) return;
    /* a plane inclined as the slopes say, not a step: |dz| <= tan(angle) times their distance, 2 h pixels */
    float across = 4.0f * (float)h * ray->footprint * DISTI_MAX(z1, z2), tangent = 0.0f;
    if (gap > 1.2f * 0.3f * across)
        tangent = sqrtf(DISTI_MAX(tracer->lipschitz * tracer->lipschitz - mean * mean, 0.0f)) / -mean;
    float inverse = 0.5f * (1.0f / z1 + 1.0f / z2);
    guess->slope = mean;
    guess->differ = 3e38f;
    guess->spread = (flatter - DISTI_MIN(slope1, slope2)) / -mean;
    guess->quality = flatter <= 0.4f * DISTI_MIN(slope1, slope2) ? 2 : 1;
    if (gap > near || gap > 1.2f * (tangent + 0.3f) * across) {
        float z = z1 > z2 ? z1 : z2, beyond = z1 > z2 ? a : b;
        int follows = z1 > z2 ? near_a : near_b;
        inverse = follows ? 1.5f / z - 0.5f / beyond : 1.0f / z;
        guess->slope = z1 > z2 ? slope1 : slope2;
        guess->quality = -1;
    } else if (near_a && near_b) {
        float line = 1.0f / inverse;
        inverse = (9.0f / z1 + 9.0f / z2 - 1.0f / a - 1.0f / b) * 0.0625f;
        guess->sag = line * inverse < 1.0f ? 1.0f / inverse - line : line - 1.0f / inverse;
        disti_guess_off(guess, &ray[-h * stride], &ray[h * stride], lattice, at, beside, h);
        guess->quality += guess->quality == 2;
    }
    guess->depth = 1.0f / inverse;
}

/* Sets up pixel (x, y) for its first query, half way between pixels at distance h known along x, y or both. 0: it
   needs none: between four hits alike that foretell it to within half of epsilon, or to within two where those along x
   and along y say the same, it is interpolated. */
static int disti_predict(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench, int x, int y,
                          int h)
{
    disti_ray *ray = &bench->rays[y * tile->width + x];
    float *depth = &bench->depth[y * tile->width + x];
    int odd_x = x & h, odd_y = y & h;
    disti_guess guess, other;
    disti_predict_axis(tracer, ray, depth, tile->lattice, odd_x ? x : y, odd_x ? y : x,
                       odd_x ? tile->width : tile->height, h, odd_x ? 1 : tile->width, &guess);
    if (odd_x && odd_y) {
        disti_predict_axis(tracer, ray, depth, tile->lattice, y, x, tile->height, h, tile->width, &other);
        if (guess.quality > 0 && other.quality > 0) {
            guess.differ = guess.depth < other.depth ? other.depth - guess.depth : guess.depth - other.depth;
            guess.depth = 0.5f * (guess.depth + other.depth);
            guess.slope = 0.5f * (guess.slope + other.slope);
            guess.off = guess.off > 0.0f && other.off > 0.0f ? DISTI_MAX(guess.off, other.off) : 0.0f;
            guess.seen = DISTI_MAX(guess.seen, other.seen);
            guess.sag = DISTI_MAX(guess.sag, other.sag);
            guess.spread = DISTI_MAX(guess.spread, other.spread);
            guess.quality = DISTI_MIN(guess.quality, other.quality);
        } else {
            if (guess.quality <= 0 && other.quality > 0) guess = other;
            guess.quality = guess.quality ? -1 : 0;
        }
    }
    ray->mode = DISTI_FIRST;
    ray->q = ray->start;
    if (tracer->how.certified) {
        ray->incline = guess.quality > 0 ? guess.slope : 0.0f;
        return 1;
    }
    if (guess.quality == 0 || !(guess.slope < -0.05f * tracer->lipschitz)) return 1; /* as in disti_ray_predicted */
    float s = (float)((double)(guess.depth / ray->cosine) - ray->base);
    float epsilon = disti_ray_epsilon(tracer, ray, s);
    if (!(s > ray->start && s < ray->leave)) return 1;
    ray->aim = (unsigned char)(guess.quality >= 2 ? 1 : 2);
    ray->target = s;
    ray->incline = guess.slope;
    int near = tile->lattice == DISTI_LATTICE; /* neighbors far from each other say where, but not how steeply */
    if (near && guess.quality >= 2 && guess.slope < -0.12f * tracer->lipschitz) /* else 0: a second query makes sure */
        ray->width = guess.slope < -0.3f * tracer->lipschitz ? DISTI_MAX(4.0f, 0.35f / (0.03f + 0.5f * guess.spread))
                                                             : 1.0f;
    ray->front.s = ray->start;
    if (guess.quality > 0 && disti_ray_aims(tracer, ray, ray->guard - 1e-3f * tracer->field->radius)) {
        int alike = guess.off <= 0.5f * epsilon || (guess.off <= 2.0f * epsilon && guess.differ <= 0.5f * epsilon);
        if (near && h == 1 && guess.quality == 3 && guess.off > 0.0f && alike) {
            ray->slope = guess.slope;
            ray->off = guess.off;
            /* at a crease amid the four, where the cubic is off by up to three times what it differs from the line */
            float error = guess.seen + epsilon + 2.0f * guess.sag / ray->cosine;
            disti_ray_end(ray, DIST_RAY_HIT, s, 0.0f, 2.0f * error);
            *depth = disti_hit_depth(ray);
            return 0;
        }
        disti_ray_aim(ray);
    }
    return 1;
}

/* Width of a pixel at the field's center. */
static float disti_pixel_width(const disti_tracer *tracer, const disti_tile *tile)
{
    double c[3];
    for (int i = 0; i < 3; i++) c[i] = tile->view->center[i] - (double)tracer->field->center[i];
    return (float)(sqrt(disti_dot(c, c)) / DISTI_MAX(fabs(tile->view->fx), fabs(tile->view->fy)));
}

/* Cones for the parts of a tile's blocks between lattice pixels that are not all hits: the outline passes there, and
   rays that only come near take many queries. For rays that have not set out. */
static void disti_outline(const disti_tracer *tracer, int worker, const disti_tile *tile, disti_bench *bench)
{
    disti_cone *cones = (disti_cone *)(void *)bench->rest;
    int first = bench->cones;
    size_t active = 0;
    for (int i = 0; i < first; i++) {
        int open = 0;
        for (int k = 0; k < 4 && cones[i].state == DISTI_CONE_BLOCKED && cones[i].size == tile->lattice; k++) {
            int x = cones[i].x + (k & 1 ? tile->lattice : 0), y = cones[i].y + (k & 2 ? tile->lattice : 0);
            open |= x < tile->width && y < tile->height && bench->rays[y * tile->width + x].status != DIST_RAY_HIT;
        }
        if (open) disti_cone_split(tracer, tile, bench, &cones[i], &active);
    }
    disti_cone_rounds(tracer, worker, tile, bench, active, DISTI_CONE_OUTLINE);
    for (int i = first; i < bench->cones; i++)
        if (cones[i].state != DISTI_CONE_SPLIT) disti_cone_finish(tracer, tile, bench, &cones[i]);
}

/* So few rays left march on beside the next pass's, instead of in nearly empty blocks of points: somewhat more queries,
   as nothing is foretold from them then, in less time. */
enum { DISTI_LATER = 6 };

static void disti_lattice_balls(const disti_tracer *tracer, const disti_tile *tile, disti_bench *bench)
{
    DIST_ASSERT(sizeof(disti_balls) <= DISTI_REST_BYTES);
    bench->balls = (disti_balls *)(void *)bench->rest;
    bench->cones = 0;
    bench->width = tile->width;
    bench->height = tile->height;
    bench->least = 0.4f * disti_pixel_width(tracer, tile);
    bench->balls->clears = 0;
    memset(bench->balls->reach, 0, (size_t)(bench->width * bench->height));
    disti_balls_look(bench, tile->lattice);
}

/* Lists what a pass asks for of the block of DISTI_PASS_BLOCK * h pixels at (x0, y0), after the `active` rays that are
   listed. Neighbors share dead units, so pictures are gone through in blocks. */
enum { DISTI_PASS_BLOCK = 16 };

static size_t disti_pass_block(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench, int x0,
                               int y0, int h, int pass, size_t active)
{
    int x1 = DISTI_MIN(x0 + DISTI_PASS_BLOCK * h, tile->width), y1 = DISTI_MIN(y0 + DISTI_PASS_BLOCK * h, tile->height);
    for (int y = y0 + (pass == 1 ? 0 : h); y < y1; y += pass == 1 ? h : 2 * h) {
        for (int x = x0 + (pass == 1 && y & h ? 0 : h); x < x1; x += 2 * h) {
            int index = y * tile->width + x;
            if (!(bench->depth[index] < 0.0f) || bench->rays[index].mode != DISTI_WAIT) continue;
            if (disti_predict(tracer, tile, bench, x, y, h)) bench->index[active++] = index;
            else if (bench->budget) bench->budget->hits++;
        }
    }
    return active;
}

static void disti_trace_lattice(const disti_tracer *tracer, int worker, const disti_tile *tile, disti_bench *bench)
{
    size_t active = 0;
    int later[DISTI_LATER];
    if (!tile->cheap) disti_lattice_balls(tracer, tile, bench);
    for (int i = 0, y = 0; y < tile->height; y++) {
        for (int x = 0; x < tile->width; x++, i++) {
            disti_ray *ray = &bench->rays[i];
            bench->depth[i] = disti_hit_depth(ray); /* of a warm start */
            if (ray->mode == DISTI_DONE) continue;
            if (((x | y) & (tile->lattice - 1)) == 0) {
                bench->index[active++] = i;
                continue;
            }
            ray->mode = DISTI_WAIT;
            bench->depth[i] = -1.0f;
        }
    }
    active = disti_trace_rounds(tracer, worker, bench, active, DISTI_LATER);
    if (bench->cones > 0) {
        memcpy(later, bench->index, active * sizeof(int));
        disti_outline(tracer, worker, tile, bench);
        memcpy(bench->index, later, active * sizeof(int));
    }
    DIST_ASSERT(6 * DISTI_TILE_RAYS * sizeof(float) <= DISTI_REST_BYTES);
    if (tile->cheap && tile->normals) bench->gradient = (float *)(void *)bench->rest; /* the cones are done with */
    for (int h = tile->lattice / 2; h > 0; h /= 2) {
        for (int pass = 1; pass <= 2; pass++) { /* between two known pixels, then amid four */
            if (bench->balls) disti_balls_look(bench, h);
            int side = DISTI_PASS_BLOCK * h;
            for (int y = 0; y < tile->height; y += side)
                for (int x = 0; x < tile->width; x += side)
                    active = disti_pass_block(tracer, tile, bench, x, y, h, pass, active);
            active = disti_trace_rounds(tracer, worker, bench, active, h > 1 || pass == 1 ? DISTI_LATER : 0);
        }
    }
    bench->balls = NULL;
}

/* What the neighbors say about the error bounds of hits, in the end. Behind a nearer neighbor, across a step in depth
   or in a dent, the nearer surface may go on in front of the hit, as the Lipschitz figure is an estimate: the bound
   reaches to there. A predicted hit may be off by half as much again as it differs from the cubic through its
   neighbors, (-1, 4, 4, -1) / 6, or from their mean if that is less: where the surface is smooth, next to nothing. At
   a small step it lies between them. Where f hardly falls at the hit it may have been flat before, and have crossed 0
   within the band's few epsilon, the default's where a finer one is asked for, as the field is no steeper for that: the
   bound reaches as far as that takes at this slope. */
static void disti_trace_doubt(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench)
{
    int n = tile->width * tile->height;
    float most = 0.02f * tracer->field->radius, farthest = 0.03f * tracer->field->radius;
    for (int i = 0, x = -1, y = 0; i < n; i++) {
        if (++x == tile->width) x = 0, y++;
        const float *depth = bench->depth + i;
        float z = *depth, doubt = 0.0f;
        if (!(z > 0.0f)) continue;
        disti_ray *ray = &bench->rays[i];
        float falls = fabsf(ray->slope);
        if (falls < 0.06f * tracer->lipschitz && ray->sign > 0.0f) {
            float flat = 8.0f * DISTI_MAX(disti_ray_epsilon(tracer, ray, ray->best), tracer->usual);
            ray->error = DISTI_MAX(ray->error, flat < farthest * falls ? flat / falls : farthest);
        }
        for (int axis = 0; axis < 2; axis++) {
            int at = axis ? y : x, end = axis ? tile->height : tile->width;
            int stride = axis ? tile->width : 1;
            float z1 = disti_depth_beside(depth, at, end, -1, stride);
            float z2 = disti_depth_beside(depth, at, end, 1, stride);
            if (!(z1 > 0.0f && z2 > 0.0f)) continue;
            float fall1 = z - z1, fall2 = z - z2, pixel = 2.0f * ray->footprint * z;
            float size1 = fabsf(fall1), size2 = fabsf(fall2);
            if (DISTI_MAX(size1, size2) > 2.0f * DISTI_MIN(size1, size2) + pixel ||
                DISTI_MIN(fall1, fall2) > 2.0f * pixel) {
                float fall = size1 > size2 ? fall1 : fall2;
                doubt = DISTI_MAX(doubt, ray->off > 0.0f && fall < 0.0f && -fall < most ? -fall : fall);
                continue;
            }
            float a = disti_depth_beside(depth, at, end, -2, stride), b = disti_depth_beside(depth, at, end, 2, stride);
            float off = 0.5f * (fall1 + fall2), cubic = off;
            if (!(ray->off > 0.0f)) continue;
            if (a > 0.0f && b > 0.0f) cubic = (4.0f * (fall1 + fall2) + a + b - z - z) / 6.0f;
            off = DISTI_MIN(fabsf(off), fabsf(cubic));
            doubt = DISTI_MAX(doubt, 1.5f * off);
        }
        ray->error = DISTI_MAX(ray->error, doubt / ray->cosine);
    }
}

enum { DISTI_ASIDE = 3 }; /* pixels that a surface is moved by, at most */

/* The same where f is off by coarse_error, which moves the surface aside, too: by coarse_error / slope, seen as so many
   pixels. The exact depth is then among those met within them (a step in depth: or a little behind), or, at an outline,
   up to half as far again behind, and at least coarse_error over a quarter of the slope. On an even surface less than
   a pixel moves it by as much less; the slope is taken as a quarter of that expected, as that is where f is worse than
   its Lipschitz figure says. */
static void disti_coarse_doubt(const disti_tracer *tracer, const disti_tile *tile, const disti_bench *bench)
{
    int n = tile->width * tile->height;
    float moved = tracer->field->coarse_error / (0.75f * tracer->lipschitz);
    for (int i = 0, x = -1, y = 0; i < n; i++) {
        if (++x == tile->width) x = 0, y++;
        float z = bench->depth[i], near = 0.0f, far = 0.0f;
        if (!(z > 0.0f)) continue;
        disti_ray *ray = &bench->rays[i];
        float pixel = 2.0f * ray->footprint * z, pixels = DISTI_MIN(moved / pixel, (float)DISTI_ASIDE);
        int reach = 1 + (int)pixels, outline = 0;
        for (int k = 0; k < 16; k++) { /* eight ways, next to it and as far as it reaches */
            int way = (k & 7) < 4 ? k & 7 : (k & 7) + 1, by = k < 8 ? 1 : reach;
            int u = x + (way % 3 - 1) * by, v = y + (way / 3 - 1) * by;
            if (u < 0 || v < 0 || u >= tile->width || v >= tile->height) continue;
            float other = bench->depth[v * tile->width + u];
            outline |= !(other > 0.0f);
            if (!(other > 0.0f)) continue;
            near = DISTI_MAX(near, z - other);
            far = DISTI_MAX(far, other - z);
        }
        float doubt = DISTI_MAX(near, far);
        int even = doubt <= 2.0f * (DISTI_MIN(near, far) + pixel);
        if (outline) doubt = DISTI_MAX(1.5f * doubt, DISTI_MIN(4.0f * moved, 2.0f * tracer->field->radius));
        else doubt *= even ? DISTI_MIN(1.0f, 4.0f * pixels) : 1.05f;
        ray->error = DISTI_MAX(ray->error, doubt / ray->cosine);
    }
}

/* Soft silhouette of the rays that miss: min |f| along each. Cones, balls and stretched steps leave no sample near the
   minimum, so it is looked for. Nodes, every 8th and then every 4th pixel, fit a parabola around their least sample or
   their block's (4 queries); then every 2nd pixel and all others get it where their nodes have it (1 query). Where f is
   so large that the nodes do, it is interpolated as well (none): what that is off by goes with the square of the nodes'
   distance over f. Next to the outline a pixel also looks where its neighbors' minima are, and fits a parabola; others
   near hits, for which no nodes speak, ask where their neighbors nearer to the outline say (1 query). A value off by ds
   costs ds^2 / 2 times the curvature: first-order exact (envelope theorem). */
enum {
    DISTI_FITTED = 1, /* its parabola has been made */
    DISTI_UNSURE,     /* beside hits: its nodes do not foretell its f; waits for neighbors nearer to the outline */
    DISTI_FORETOLD    /* they do, in this round */
};

static int disti_wants_minimum(const disti_ray *ray)
{
    return ray->status == DIST_RAY_MISS && ray->enter < ray->leave && !ray->kept;
}

static int disti_has_minimum(const disti_ray *ray)
{
    return ray->status == DIST_RAY_MISS && ray->enter < ray->leave && ray->fbest < 2e38f;
}

/* What is known of a tile's rays while their least |f| is looked for. */
typedef struct disti_minima {
    const disti_tracer *tracer;
    const disti_tile *tile;
    const disti_bench *bench;
    int worker;
    float radius, pixel;
    float near, far; /* rays with f below near are fitted one by one; from far on those of every 4th pixel do for all */
    float plateau;   /* from this f on the field may be clamped, and f between nodes is all the same */
    int *cells[2];   /* first pixels of blocks between nodes, of this round and of the next */
    int *close;      /* rays with f of at most far; at first all whose least |f| is looked for */
    int *fits;       /* rays that are to be fitted: width > 0 */
    int *fronts[2];  /* rays that are held against their neighbors, in this round and in the next: side = 1 */
    size_t cell_count, close_count, fit_count, front_count;
} disti_minima;

enum { DISTI_NODE = 4 }; /* pixels between nodes; the tile's last row and column have some, too */
enum { DISTI_NODE_CELLS = (DISTI_TILE / 2 + 1) * (DISTI_TILE / 2 + 1) };

/* s of the least of the parabola through (-h, left), (0, middle), (h, right), within (-h, h). */
static float disti_parabola(float h, float left, float middle, float right)
{
    float curvature = left - 2.0f * middle + right;
    if (!(curvature > 0.0f)) return left < right ? -0.5f * h : 0.5f * h;
    float s = 0.5f * h * (left - right) / curvature;
    return s > h ? h : s < -h ? -h : s;
}

/* s within the ray's part of the bounding sphere. */
static float disti_ray_within(const disti_ray *ray, float s)
{
    return DISTI_MIN(DISTI_MAX(s, ray->enter), ray->leave);
}

static float disti_ray_distance(const disti_ray *ray)
{
    return (float)(ray->base + (double)ray->best);
}

/* Lists f at s of ray `index` to be asked for. */
static size_t disti_minima_list(const disti_minima *m, int index, float s, size_t count)
{
    disti_ray *ray = &m->bench->rays[index];
    ray->q = disti_ray_within(ray, s);
    disti_ray_point(ray, ray->q, m->bench->points + 3 * count);
    m->bench->index[count] = index;
    return count + 1;
}

/* The same where the distance from the camera is t. */
static size_t disti_minima_list_at(const disti_minima *m, int index, float t, size_t count)
{
    return disti_minima_list(m, index, (float)((double)t - m->bench->rays[index].base), count);
}

/* Evaluates the `count` samples that are listed, or as many as the budget has room for. */
static size_t disti_minima_eval(const disti_minima *m, size_t count)
{
    count = disti_query(m->tracer, m->worker, m->bench, count);
    m->bench->stats->silhouette_queries += count;
    return count;
}

/* Keeps a sample of ray `index`, which misses. Well within a solid that it did not start in it is no miss: the ray
   stepped over that, as f is steeper than its Lipschitz figure; by how much, its front tells, or its cones' least
   sample. */
static void disti_minima_keep(const disti_minima *m, int index, float s, float f)
{
    const disti_tracer *tracer = m->tracer;
    disti_ray *ray = &m->bench->rays[index];
    if (ray->status != DIST_RAY_MISS) return;
    float most = -DISTI_MAX(disti_ray_epsilon(tracer, ray, s), tracer->field->coarse_error);
    if (!(f < most) || !disti_finite(f) || ray->sign < 0.0f) {
        disti_keep_least(ray, s, f);
        return;
    }
    int w = m->tile->width, block = index / w / DISTI_LEAST_BLOCK * DISTI_LEAST_ROW + index % w / DISTI_LEAST_BLOCK;
    disti_sample from = ray->front;
    float aside = 0.0f, *steepest = &m->bench->stats->steepest;
    if (!(from.f > 0.0f)) { /* a cone's axis, beside the ray by no more than half its diagonal */
        float t = m->bench->least_of->t[block];
        from.f = m->bench->least_of->f[block];
        from.s = (float)((double)t - ray->base);
        aside = 1.5f * (float)DISTI_CONE_FIRST * ray->footprint * t + m->bench->least_of->out[block];
    }
    float step = fabsf(s - from.s) + aside, rise = disti_empty(tracer, from.f) + disti_empty(tracer, -f);
    rise = rise * tracer->lipschitz - 2.0f * tracer->noise;
    if (from.f < 2e38f && step > 0.0f && rise > tracer->lipschitz * step && rise > *steepest * step)
        *steepest = rise / step;
    disti_ray_end(ray, DIST_RAY_UNRESOLVED, s, f, DISTI_MAX(s - ray->enter, 0.0f));
}

/* And keeps what they say. */
static void disti_minima_ask(const disti_minima *m, size_t count)
{
    count = disti_minima_eval(m, count);
    for (size_t k = 0; k < count; k++) {
        disti_minima_keep(m, m->bench->index[k], m->bench->rays[m->bench->index[k]].q, m->bench->sdf[k]);
    }
}

static void disti_minima_want_fit(disti_minima *m, int index, float width)
{
    m->bench->rays[index].width = width;
    m->fits[m->fit_count++] = index;
}

/* Parabolas through three samples around the least one of the rays in `fits`; width: how far apart, in units of f. Both
   sides are asked for in one call, then where the parabola is least; b.f is its value there. Beyond a side f falls
   farther, and the ray stays in the list: twice as wide, around that side. */
static void disti_minima_parabolas(disti_minima *m)
{
    const disti_bench *bench = m->bench;
    size_t falling = 0;
    for (size_t i = 0; i < m->fit_count;) { /* as many rays as there is room for */
        size_t count = 0;
        for (; i < m->fit_count && count + 2 <= (size_t)DISTI_TILE_RAYS; i++) {
            disti_ray *ray = &bench->rays[m->fits[i]];
            ray->width = DISTI_MAX(ray->width * ray->fbest, 2e-3f * m->radius);
            ray->a.s = ray->best; /* the least sample as it stood */
            ray->a.f = ray->fbest;
            count = disti_minima_list(m, m->fits[i], ray->a.s - ray->width, count);
            count = disti_minima_list(m, m->fits[i], ray->a.s + ray->width, count);
        }
        size_t asked = disti_minima_eval(m, count), kept = 0;
        for (size_t k = 0; k + 1 < asked; k += 2) {
            int index = bench->index[k];
            disti_ray *ray = &bench->rays[index];
            float width = ray->width, left = bench->sdf[k], right = bench->sdf[k + 1];
            disti_minima_keep(m, index, disti_ray_within(ray, ray->a.s - width), left);
            disti_minima_keep(m, index, disti_ray_within(ray, ray->a.s + width), right);
            if (ray->status != DIST_RAY_MISS) continue;
            float fall = left < right ? right - left : left - right;
            if (ray->best != ray->a.s && !(left - 2.0f * ray->a.f + right > 0.5f * fall)) {
                ray->width = 2.0f * width / DISTI_MAX(ray->fbest, 1e-30f);
                m->fits[falling++] = index;
                continue;
            }
            float least = disti_parabola(width, left, ray->a.f, right);
            ray->b.f = ray->a.f - 0.25f * (left - right) * least / width;
            kept = disti_minima_list(m, index, ray->a.s + least, kept);
            ray->moved = DISTI_FITTED;
        }
        disti_minima_ask(m, kept);
    }
    m->fit_count = falling;
}

static void disti_minima_fit(disti_minima *m)
{
    for (int k = 0; k < 5 && m->fit_count > 0; k++) disti_minima_parabolas(m);
    m->fit_count = 0;
}

/* h: a power of two */
static int disti_is_node(const disti_tile *tile, int x, int y, int h)
{
    return (!(x & (h - 1)) || x == tile->width - 1) && (!(y & (h - 1)) || y == tile->height - 1);
}

/* The next node's column or row after that at `at`, of nodes h apart below `end`. */
static int disti_node_after(int at, int h, int end)
{
    return at == end - 1 ? end : DISTI_MIN((at | (h - 1)) + 1, end - 1);
}

/* Four nodes and what they say about the pixels between. A node whose own minimum is elsewhere on the ray (of another
   part of the shape) than the least one's is left out. */
typedef struct disti_corners {
    int x0, y0;
    float x_scale, y_scale;
    float t[4], f[4], weight[4]; /* distance from the camera, f; weight 0: left out */
    float lowest;                /* f */
    int agree;                   /* how many there are */
} disti_corners;

static void disti_minima_corners(const disti_minima *m, int x0, int y0, int h, disti_corners *corners)
{
    int w = m->tile->width, x1 = DISTI_MIN(x0 + h, w - 1), y1 = DISTI_MIN(y0 + h, m->tile->height - 1), least = -1;
    corners->x0 = x0;
    corners->y0 = y0;
    corners->x_scale = 1.0f / (float)DISTI_MAX(x1 - x0, 1);
    corners->y_scale = 1.0f / (float)DISTI_MAX(y1 - y0, 1);
    corners->agree = 0;
    for (int k = 0; k < 4; k++) {
        const disti_ray *ray = &m->bench->rays[(k & 2 ? y1 : y0) * w + (k & 1 ? x1 : x0)];
        corners->weight[k] = disti_has_minimum(ray) ? 1.0f : 0.0f;
        corners->t[k] = disti_ray_distance(ray);
        corners->f[k] = ray->fbest;
        if (corners->weight[k] > 0.0f && (least < 0 || ray->fbest < corners->f[least])) least = k;
    }
    if (least < 0) return;
    corners->lowest = corners->f[least];
    for (int k = 0; k < 4; k++) {
        float off = corners->t[k] - corners->t[least];
        if (!((off < 0.0f ? -off : off) <= 0.1f * m->radius)) corners->weight[k] = 0.0f;
        corners->agree += corners->weight[k] > 0.0f;
    }
}

/* Interpolated at (x, y), where one agrees at least. */
static void disti_corners_at(const disti_corners *corners, int x, int y, float *t, float *f)
{
    float u = (float)(x - corners->x0) * corners->x_scale, v = (float)(y - corners->y0) * corners->y_scale, sum = 0.0f;
    *t = *f = 0.0f;
    for (int k = 0; k < 4; k++) {
        if (!(corners->weight[k] > 0.0f)) continue;
        float weight = (k & 1 ? u : 1.0f - u) * (k & 2 ? v : 1.0f - v) + 1e-3f;
        *t += weight * corners->t[k];
        *f += weight * corners->f[k];
        sum += weight;
    }
    *t /= sum;
    *f /= sum;
}

/* Gives all rays of a block of h by h pixels the minimum that its corners say. */
static void disti_minima_fill(const disti_minima *m, const disti_corners *corners, int h)
{
    int x1 = DISTI_MIN(corners->x0 + h, m->tile->width), y1 = DISTI_MIN(corners->y0 + h, m->tile->height);
    const float *t = corners->t, *f = corners->f;
    for (int y = corners->y0; y < y1; y++) {
        float v = (float)(y - corners->y0) * corners->y_scale;
        float t0 = t[0] + v * (t[2] - t[0]), f0 = f[0] + v * (f[2] - f[0]);
        float t1 = corners->x_scale * (t[1] + v * (t[3] - t[1]) - t0);
        float f1 = corners->x_scale * (f[1] + v * (f[3] - f[1]) - f0);
        disti_ray *ray = &m->bench->rays[y * m->tile->width + corners->x0];
        for (int x = 0; x < x1 - corners->x0; x++, ray++)
            if (disti_wants_minimum(ray))
                disti_keep_least(ray, (float)((double)(t0 + t1 * (float)x) - ray->base), f0 + f1 * (float)x);
    }
}

/* The block's least sample on an axis of its cones, at a distance of *t; 3e38: none. */
static float disti_minima_least(const disti_minima *m, int block, float *t)
{
    const disti_least *least = m->bench->least_of;
    *t = least->t[block];
    return least->out[block] > 0.0f ? 3e38f : least->f[block];
}

/* A node amid four others: from f = enough on it takes what they say, else it asks there. */
static size_t disti_minima_place(disti_minima *m, const disti_corners *corners, int x, int y, int h, float enough,
                                 size_t count)
{
    int index = y * m->tile->width + x, block = y / DISTI_LEAST_BLOCK * DISTI_LEAST_ROW + x / DISTI_LEAST_BLOCK;
    disti_ray *ray = &m->bench->rays[index];
    float t, f = disti_minima_least(m, block, &t);
    if (corners->agree > 0) disti_corners_at(corners, x, y, &t, &f);
    ray->b.f = corners->agree == 4 ? f : 0.0f; /* what is to be expected; beside hits nothing is */
    float s = f < 2e38f ? (float)((double)t - ray->base) : 0.0f;
    if (corners->agree == 4 && f > enough) {
        disti_keep_least(ray, s, f);
        return count;
    }
    if (corners->agree > 0 || ray->fbest > 2e38f) count = disti_minima_list(m, index, s, count);
    if (h == DISTI_NODE) disti_minima_want_fit(m, index, 0.35f);
    return count;
}

/* Nodes 8 pixels apart: where their blocks of cones or they themselves had the least sample. */
static void disti_minima_first(disti_minima *m)
{
    const int h = 2 * DISTI_NODE, w = m->tile->width;
    for (int again = 0; again < 2; again++) {
        size_t count = 0;
        for (int y = 0; y < m->tile->height; y = disti_node_after(y, h, m->tile->height)) {
            for (int x = 0; x < w; x = disti_node_after(x, h, w)) {
                int block = y / DISTI_LEAST_BLOCK * DISTI_LEAST_ROW + x / DISTI_LEAST_BLOCK;
                disti_ray *ray = &m->bench->rays[y * w + x];
                float t, f = disti_minima_least(m, block, &t);
                if (!disti_wants_minimum(ray)) continue;
                if (!again) {
                    count = disti_minima_list(m, y * w + x, f < 2e38f ? (float)((double)t - ray->base) : 0.0f, count);
                    disti_minima_want_fit(m, y * w + x, 0.7f);
                    continue;
                }
                /* the cones' samples are far apart: where the first fit helped, once more */
                if (ray->moved == DISTI_FITTED && ray->best == ray->a.s) continue;
                if (ray->fbest < DISTI_MIN(4.0f * m->far, m->plateau)) disti_minima_want_fit(m, y * w + x, 0.35f);
            }
        }
        disti_minima_ask(m, count);
        disti_minima_fit(m);
    }
}

/* Nodes of half and half that distance, down to all pixels, in blocks that nodes stand around: where those say it all,
   it is filled with that, else it falls into four. */
static void disti_minima_nodes(disti_minima *m)
{
    const disti_bench *bench = m->bench;
    int w = m->tile->width, height = m->tile->height;
    size_t cell_count = m->cell_count;
    disti_minima_first(m);
    for (int h = DISTI_NODE, round = 0; h >= 1; h /= 2, round ^= 1) {
        const int *cells = m->cells[round];
        int *next = m->cells[round ^ 1];
        /* from this f on nodes 2 h apart do for what lies between them; that of a plateau is all the same */
        float apart = 2.0f * (float)h / (float)DISTI_NODE, enough = DISTI_MIN(apart * apart * m->far, m->plateau);
        size_t count = 0, next_count = 0;
        for (size_t i = 0; i < cell_count; i++) {
            disti_corners corners;
            int x0 = cells[i] % w, y0 = cells[i] / w, x1 = DISTI_MIN(x0 + 2 * h, w), y1 = DISTI_MIN(y0 + 2 * h, height);
            disti_minima_corners(m, x0, y0, 2 * h, &corners);
            if (corners.agree == 4 && corners.lowest > enough) {
                disti_minima_fill(m, &corners, 2 * h);
                continue;
            }
            for (int y = y0; y < y1; y = disti_node_after(y, h, height))
                for (int x = x0; x < x1; x = disti_node_after(x, h, w))
                    if (!disti_is_node(m->tile, x, y, 2 * h) && disti_wants_minimum(&bench->rays[y * w + x]))
                        count = disti_minima_place(m, &corners, x, y, h, enough, count);
            for (int y = y0; y < y1 && h > 1; y += h)
                for (int x = x0; x < x1; x += h) next[next_count++] = y * w + x;
        }
        disti_minima_ask(m, count);
        for (size_t k = 0; k < count && h < DISTI_NODE; k++) { /* f larger than foretold: the least is elsewhere */
            disti_ray *ray = &bench->rays[bench->index[k]];
            if (!(ray->fbest > m->near && ray->fbest < m->far)) continue; /* nearer ones are fitted in any case */
            if (!(ray->b.f > 0.0f)) ray->moved = DISTI_UNSURE;
            else if (ray->fbest > 1.2f * ray->b.f + 5e-4f * m->radius) disti_minima_want_fit(m, bench->index[k], 0.35f);
        }
        size_t fits = m->fit_count;
        m->fit_count = 0;
        for (size_t k = 0; k < fits; k++)
            if (!(bench->rays[m->fits[k]].fbest > m->far)) m->fits[m->fit_count++] = m->fits[k];
        disti_minima_fit(m);
        cell_count = next_count;
    }
}

/* The neighbors of ray `index`: right, left, below, above; NULL beyond the tile. */
static void disti_rays_beside(const disti_minima *m, int index, const disti_ray *other[4])
{
    int w = m->tile->width, x = index % w, y = index / w;
    const disti_ray *ray = &m->bench->rays[index];
    other[0] = x + 1 < w ? ray + 1 : NULL;
    other[1] = x > 0 ? ray - 1 : NULL;
    other[2] = y + 1 < m->tile->height ? ray + w : NULL;
    other[3] = y > 0 ? ray - w : NULL;
}

static int disti_minima_beside_hit(const disti_minima *m, int index)
{
    const disti_ray *other[4];
    disti_rays_beside(m, index, other);
    for (int k = 0; k < 4; k++)
        if (other[k] && other[k]->status == DIST_RAY_HIT) return 1;
    return 0;
}

/* Rays also look where their neighbors' least samples are. */
static void disti_minima_look(const disti_minima *m)
{
    size_t count = 0;
    for (size_t i = 0; i < m->close_count; i++) {
        disti_ray *ray = &m->bench->rays[m->close[i]];
        const disti_ray *best = ray, *other[4];
        disti_rays_beside(m, m->close[i], other);
        for (int k = 0; k < 4; k++)
            if (other[k] && disti_has_minimum(other[k]) && other[k]->fbest < best->fbest) best = other[k];
        float away = disti_ray_distance(best) - disti_ray_distance(ray);
        if (!(away * away > 4e-4f * m->radius * m->radius)) continue;
        if (ray->moved == DISTI_FITTED) ray->moved = 0;
        count = disti_minima_list_at(m, m->close[i], disti_ray_distance(best), count);
    }
    disti_minima_ask(m, count);
}

/* Fits the rays nearest to the outline and those beside hits. Of coarse pixels f may be no parabola: once more, in a
   narrower one, where it was not what the first said. */
static void disti_minima_outline(disti_minima *m)
{
    for (int fine = 0; fine <= (m->pixel > 0.01f * m->radius); fine++) {
        for (size_t i = 0; i < m->close_count; i++) {
            const disti_ray *ray = &m->bench->rays[m->close[i]];
            int fitted = ray->moved == DISTI_FITTED, good = fabsf(ray->fbest - ray->b.f) < 0.02f * ray->fbest;
            if (fine ? !fitted || good : fitted) continue;
            if (ray->fbest < m->near || disti_minima_beside_hit(m, m->close[i]))
                disti_minima_want_fit(m, m->close[i], fine ? 0.1f : 0.35f);
        }
        disti_minima_fit(m);
    }
}

static size_t disti_minima_push(disti_minima *m, int *front, size_t count, int index)
{
    disti_ray *ray = &m->bench->rays[index];
    if (ray->side || !disti_wants_minimum(ray)) return count;
    ray->side = 1;
    front[count] = index;
    return count + 1;
}

/* From one pixel to the next the least |f| changes by no more than the Lipschitz figure times what they are apart
   there; at a hit it is 0. A ray that has more than that, b.f, found another minimum: it looks where its neighbor has
   its own, at distance *t. */
static int disti_minima_amiss(const disti_minima *m, int index, float *t)
{
    disti_ray *ray = &m->bench->rays[index];
    const disti_ray *other[4];
    float least = DISTI_MIN(ray->fbest, m->far);
    int found = 0;
    disti_rays_beside(m, index, other);
    for (int k = 0; k < 4; k++) {
        int hit = other[k] && other[k]->status == DIST_RAY_HIT;
        if (!hit && !(other[k] && disti_has_minimum(other[k]))) continue;
        float at = disti_ray_distance(other[k]), f = hit ? 0.0f : fabsf(other[k]->fbest);
        float most = f + 2.1f * m->tracer->lipschitz * ray->footprint * at;
        if (!(most < least)) continue;
        ray->b.f = least = most;
        *t = at;
        found = 1;
    }
    return found;
}

/* Looks from neighbor to neighbor, from those that are close and those beside hits on, as long as that finds less. */
static void disti_minima_spread(disti_minima *m)
{
    int w = m->tile->width, *front = m->fronts[0], *next = m->fronts[1];
    size_t fronts = m->front_count;
    for (size_t i = 0; i < m->close_count; i++) fronts = disti_minima_push(m, front, fronts, m->close[i]);
    while (fronts > 0) {
        size_t count = 0, found = 0;
        for (size_t i = 0; i < fronts; i++) {
            disti_ray *ray = &m->bench->rays[front[i]];
            float t = 0.0f;
            ray->side = 0;
            ray->a.f = ray->fbest;
            if (disti_minima_amiss(m, front[i], &t)) count = disti_minima_list_at(m, front[i], t, count);
        }
        memcpy(front, m->bench->index, count * sizeof(int));
        disti_minima_ask(m, count);
        for (size_t i = 0; i < count; i++) {
            const disti_ray *ray = &m->bench->rays[front[i]];
            if (!(fabsf(ray->fbest) < 0.9f * fabsf(ray->a.f))) continue;
            if (ray->fbest < m->near || ray->fbest > ray->b.f) disti_minima_want_fit(m, front[i], 0.35f);
            front[found++] = front[i];
        }
        disti_minima_fit(m);
        fronts = 0;
        for (size_t i = 0; i < found; i++) {
            int x = front[i] % w, y = front[i] / w;
            if (x > 0) fronts = disti_minima_push(m, next, fronts, front[i] - 1);
            if (x + 1 < w) fronts = disti_minima_push(m, next, fronts, front[i] + 1);
            if (y > 0) fronts = disti_minima_push(m, next, fronts, front[i] - w);
            if (y + 1 < m->tile->height) fronts = disti_minima_push(m, next, fronts, front[i] + w);
        }
        int *last = front;
        front = next;
        next = last;
    }
}

/* What the neighbors nearer to the outline, one or two, say of an unsure ray: with the pixel between them they span a
   plane, at a straight edge of the shape the truth. Returns 0 if there is none. */
static int disti_minima_foretell(const disti_minima *m, int index, float *t, float *f)
{
    const disti_ray *ray = &m->bench->rays[index], *inner[2] = {NULL, NULL}, *others[4];
    disti_rays_beside(m, index, others);
    for (int k = 0; k < 4; k++) {
        const disti_ray *other = others[k], *known = inner[k / 2];
        if (!other || !disti_has_minimum(other) || other->moved >= DISTI_UNSURE || other->fbest > ray->fbest) continue;
        if (!known || other->fbest < known->fbest) inner[k / 2] = other;
    }
    if (!inner[0] && !inner[1]) return 0;
    const disti_ray *least = !inner[1] || (inner[0] && inner[0]->fbest < inner[1]->fbest) ? inner[0] : inner[1];
    *t = disti_ray_distance(least);
    *f = least->fbest + 1.4f * ray->footprint * *t; /* 0.7 pixels */
    if (!inner[0] || !inner[1]) return 1;
    const disti_ray *between = inner[0] + (inner[1] - ray);
    if (!disti_has_minimum(between) || between->moved >= DISTI_UNSURE) return 1;
    float far = 0.1f * m->radius, base = disti_ray_distance(between);
    float u = disti_ray_distance(inner[0]) - base, v = disti_ray_distance(inner[1]) - base;
    if (DISTI_MAX(u * u, v * v) > far * far) return 1; /* of another part of the shape */
    *t = base + u + v;
    *f = DISTI_MAX(inner[0]->fbest + inner[1]->fbest - between->fbest, 0.0f);
    return 1;
}

/* The unsure rays, from the outline outward: asked for where the neighbors say (1 query), fitted where f is larger than
   they say. Those that no neighbor tells anything of are fitted. */
static void disti_minima_sweep(disti_minima *m)
{
    for (;;) {
        size_t count = 0, unsure = 0, told = 0;
        for (size_t i = 0; i < m->close_count; i++) { /* of those that are close only the unsure ones still matter */
            int index = m->close[i];
            disti_ray *ray = &m->bench->rays[index];
            float t = 0.0f;
            if (ray->moved != DISTI_UNSURE) continue;
            m->close[unsure++] = index;
            if (!disti_minima_foretell(m, index, &t, &ray->b.f)) continue;
            told++;
            ray->moved = DISTI_FORETOLD;
            float away = t - disti_ray_distance(ray), near = 0.1f * ray->fbest;
            if (away * away > near * near) count = disti_minima_list_at(m, index, t, count);
        }
        if (unsure == 0) return;
        m->close_count = unsure;
        disti_minima_ask(m, count);
        for (size_t i = 0; i < unsure; i++) {
            disti_ray *ray = &m->bench->rays[m->close[i]];
            int wrong = ray->fbest > 1.1f * ray->b.f + 5e-4f * m->radius;
            if (told && ray->moved == DISTI_UNSURE) continue;
            if (wrong || ray->moved == DISTI_UNSURE) disti_minima_want_fit(m, m->close[i], 0.35f);
            ray->moved = 0;
        }
        disti_minima_fit(m);
    }
}

/* Lists the rays whose least |f| is looked for, and the blocks that have one. */
static void disti_minima_begin(disti_minima *m)
{
    int w = m->tile->width, height = m->tile->height, h = 2 * DISTI_NODE;
    for (int y0 = 0; y0 < height; y0 += h) {
        for (int x0 = 0; x0 < w; x0 += h) {
            int x1 = DISTI_MIN(x0 + h, w), y1 = DISTI_MIN(y0 + h, height);
            size_t before = m->close_count;
            for (int y = y0; y < y1; y++) {
                for (int i = y * w + x0; i < y * w + x1; i++) {
                    m->bench->rays[i].moved = m->bench->rays[i].side = 0;
                    m->close[m->close_count] = i;
                    m->close_count += (size_t)disti_wants_minimum(&m->bench->rays[i]);
                }
            }
            if (m->close_count > before) m->cells[0][m->cell_count++] = y0 * w + x0;
        }
    }
}

static void disti_silhouette(const disti_tracer *tracer, int worker, const disti_tile *tile, const disti_bench *bench)
{
    disti_minima minima, *m = &minima;
    size_t at = 0;
    float radius = tracer->field->radius, clamp = tracer->field->clamp, pixel = disti_pixel_width(tracer, tile);
    memset(m, 0, sizeof *m);
    m->tracer = tracer;
    m->tile = tile;
    m->bench = bench;
    m->worker = worker;
    m->radius = radius;
    m->pixel = pixel;
    /* where f between nodes, of curvature 1 / f, is off by about (4 pixels)^2 / 8 f = 1e-3 radii */
    m->plateau = clamp > 0.0f ? 0.98f * clamp : 3e38f;
    m->far = DISTI_MIN(DISTI_MAX(0.05f, 1.5e3f * (pixel / radius) * (pixel / radius)) * radius, m->plateau);
    /* within two pixels of the outline, within fewer where pixels are small */
    m->near = DISTI_MAX(0.005f, DISTI_MIN(2.0f, 150.0f * pixel / radius) * pixel / radius) * radius;
    int **rays[4] = {&m->close, &m->fits, &m->fronts[0], &m->fronts[1]};
    for (int k = 0; k < 2; k++) m->cells[k] = (int *)disti_take(bench->rest, &at, DISTI_NODE_CELLS, sizeof(int));
    for (int k = 0; k < 4; k++) *rays[k] = (int *)disti_take(bench->rest, &at, DISTI_TILE_RAYS, sizeof(int));
    DIST_ASSERT(at <= (size_t)DISTI_REST_BYTES);
    disti_minima_begin(m);
    if (m->close_count == 0) return;
    disti_minima_nodes(m);
    size_t all = m->close_count;
    m->close_count = 0;
    for (size_t i = 0; i < all; i++) {
        int index = m->close[i];
        if (!(bench->rays[index].fbest > m->far)) m->close[m->close_count++] = index;
        else if (disti_minima_beside_hit(m, index))
            m->front_count = disti_minima_push(m, m->fronts[0], m->front_count, index);
    }
    disti_minima_look(m);
    disti_minima_outline(m);
    disti_minima_spread(m);
    disti_minima_sweep(m);
}

#ifndef DIST_NO_PAPER
/* The paper's tracer as its authors' code runs it, so that Table 1 can be measured row by row and gradients compared:
     t <- t + alpha clamp(f, 0.1) from the unit sphere on;   the sample of smallest |f| of the whole ray gives the
     distance, t_k + clamp(f_k);   hit: t before the exit and smallest |f| <= epsilon and, without coarse-to-fine,
     first f > epsilon.
   Coarse-to-fine starts with a ray for each 4 x 4, then 2 x 2 pixels, three steps each; children go on at their
   parent's distance and inherit its samples, although those do not lie on the child's ray. 0.1 is 0.1 radii here. */
typedef struct disti_paper_level { /* its rays, in rows */
    disti_ray *rays;
    float *samples; /* f and point of the K samples of smallest |f| of each ray, ascending; NULL: not wanted */
    size_t n, across, stride; /* stride: of the samples' rows, in rays */
} disti_paper_level;

static float *disti_paper_samples(const disti_tracer *tracer, const disti_paper_level *level, size_t i)
{
    size_t place = i / level->across * level->stride + i % level->across;
    return level->samples ? level->samples + place * (size_t)tracer->how.samples * 4 : NULL;
}

static void disti_paper_keep(float *samples, int count, float f, const float *p)
{
    int at = count;
    while (at > 0 && !(fabsf(samples[4 * (at - 1)]) <= fabsf(f))) at--;
    if (at == count) return;
    memmove(samples + 4 * (at + 1), samples + 4 * at, (size_t)(count - 1 - at) * 4 * sizeof(float));
    samples[4 * at] = f;
    memcpy(samples + 4 * at + 1, p, 3 * sizeof(float));
}

static void disti_paper_clear(const disti_tracer *tracer, const disti_paper_level *level)
{
    for (size_t i = 0; i < level->n && level->samples; i++) {
        float *samples = disti_paper_samples(tracer, level, i);
        memset(samples, 0, (size_t)tracer->how.samples * 4 * sizeof(float));
        for (int k = 0; k < tracer->how.samples; k++) samples[4 * k] = 3e38f;
    }
}

static float disti_clamp(float f, float limit)
{
    return f > limit ? limit : f < -limit ? -limit : f;
}

/* A step of each ray that is not done or, unless `all` are to go on, past the exit or at the surface, as many as the
   budget has room for. front: t, last f; a.f: first f of the level; b.f: smallest |f| there; moved: 1 if one was not
   finite. */
static size_t disti_paper_march(const disti_tracer *tracer, int worker, const disti_bench *bench,
                                const disti_paper_level *level, int all)
{
    float alpha = disti_paper_alpha(&tracer->how), clamp = 0.1f * tracer->field->radius;
    size_t count = 0;
    for (size_t i = 0; i < level->n; i++) {
        const disti_ray *ray = &level->rays[i];
        if (ray->mode == DISTI_DONE) continue;
        if (!all && !(ray->front.s < ray->leave && fabsf(ray->front.f) >= tracer->epsilon)) continue;
        disti_ray_point(ray, ray->front.s, bench->points + 3 * count);
        bench->index[count++] = (int)i;
    }
    count = disti_query(tracer, worker, bench, count);
    for (size_t k = 0; k < count; k++) {
        disti_ray *ray = &level->rays[bench->index[k]];
        float f = bench->sdf[k], *samples = disti_paper_samples(tracer, level, (size_t)bench->index[k]);
        disti_keep_least(ray, ray->front.s, f);
        if (samples) disti_paper_keep(samples, tracer->how.samples, f, bench->points + 3 * k);
        if (ray->steps == 0) ray->a.f = f;
        if (ray->steps == 0 || fabsf(f) < ray->b.f) ray->b.f = fabsf(f);
        ray->front.f = f;
        if (disti_finite(f)) ray->front.s += alpha * disti_clamp(f, clamp);
        else ray->moved = 1; /* and stays: a coarse ray's children go on from there */
        ray->steps++;
    }
    return count;
}

/* Rays go on where their parents, each of 2 x 2, are: same distance along the ray, the parent's samples. */
static void disti_paper_inherit(const disti_tracer *tracer, const disti_paper_level *parents,
                                const disti_paper_level *level)
{
    for (size_t i = 0; i < level->n; i++) {
        size_t above = i / level->across / 2 * parents->across + i % level->across / 2;
        const disti_ray *parent = &parents->rays[above];
        disti_ray *ray = &level->rays[i];
        if (ray->mode == DISTI_DONE) continue;
        ray->front.s = (float)(parent->base + (double)parent->front.s - ray->base);
        ray->best = (float)(parent->base + (double)parent->best - ray->base);
        ray->fbest = parent->fbest;
        ray->steps = 0;
        if (level->samples)
            memcpy(disti_paper_samples(tracer, level, i), disti_paper_samples(tracer, parents, above),
                   (size_t)tracer->how.samples * 4 * sizeof(float));
    }
}

/* A level of coarse rays: of blocks of `scale` pixels, centers at s g + (s - 1) / 2; alive where a pixel under them
   meets the sphere. A coarse ray that itself misses it starts at the sphere's tangent length. Three steps each. */
static void disti_paper_coarse(const disti_tracer *tracer, int worker, const disti_tile *tile, const disti_bench *bench,
                               int scale, const disti_paper_level *parents, disti_paper_level *level)
{
    int across = (tile->width + scale - 1) / scale, down = (tile->height + scale - 1) / scale;
    level->across = level->stride = (size_t)across;
    level->n = (size_t)(across * down);
    for (int g = 0; g < across * down; g++) {
        int x0 = g % across * scale, y0 = g / across * scale, alive = 0;
        double direction[3], world[3];
        disti_ray *ray = &level->rays[g];
        disti_view_direction(tile->view, tile->x + x0 + 0.5 * (scale - 1), tile->y + y0 + 0.5 * (scale - 1), direction);
        disti_rotate_back(tile->view->rotation, direction, world);
        disti_ray_init(tracer->field, tile->view->center, world, 0.0, ray);
        for (int y = y0; y < DISTI_MIN(y0 + scale, tile->height); y++)
            for (int x = x0; x < DISTI_MIN(x0 + scale, tile->width); x++)
                alive |= bench->rays[y * tile->width + x].mode != DISTI_DONE;
        if (alive && ray->mode == DISTI_DONE) ray->front.s = 0.0f; /* the closest approach */
        ray->mode = alive ? DISTI_MARCH : DISTI_DONE;
    }
    disti_paper_clear(tracer, level);
    if (parents) disti_paper_inherit(tracer, parents, level);
    for (int k = 0; k < 3; k++) bench->stats->cone_queries += disti_paper_march(tracer, worker, bench, level, 1);
}

static void disti_paper_finish(const disti_tracer *tracer, disti_ray *ray)
{
    float epsilon = tracer->epsilon;
    int first = tracer->how.paper_row == DIST_PAPER_COARSE_TO_FINE || ray->a.f > epsilon;
    int before = ray->front.s < ray->leave;
    float f = ray->fbest, magnitude = f < 0.0f ? -f : f;
    if (ray->steps == 0) { /* without budget: its parent's sample */
        ray->q = ray->best;
        disti_ray_give_up(ray);
        return;
    }
    ray->mode = DISTI_DONE;
    ray->status = DIST_RAY_MISS;
    if (ray->moved) ray->status = DIST_RAY_NOT_FINITE;
    else if (before && ray->b.f <= epsilon && first) ray->status = DIST_RAY_HIT;
    else if (before && !first && ray->a.f < 0.0f) ray->status = DIST_RAY_INSIDE;
    else if (before) ray->status = DIST_RAY_UNRESOLVED;
    /* behind the camera by more than rounding: f < 0 at first, so it went back */
    int hit = ray->status == DIST_RAY_HIT, ends = hit || ray->status == DIST_RAY_UNRESOLVED;
    int behind = ends && ray->base + (double)ray->best < -(double)tracer->noise;
    if (behind || ray->status == DIST_RAY_INSIDE) {
        disti_ray_end(ray, DIST_RAY_INSIDE, ray->enter, ray->a.f, 0.0f);
        return;
    }
    ray->error = before && ray->status == DIST_RAY_UNRESOLVED
                     ? DISTI_MAX(ray->leave - ray->best, ray->best - ray->enter) /* steps may have gone too far */
                     : magnitude;
    if (hit) ray->best += disti_clamp(f, 0.1f * tracer->field->radius);
    ray->best = DISTI_MAX(ray->best, (float)-ray->base);
}

/* Rays that are INSIDE have f where they start, which is their first sample but for coarse-to-fine's, and of the tape's
   samples that alone: those of the march lie at the way out. */
static void disti_paper_inside(const disti_tracer *tracer, int worker, const disti_bench *bench,
                               const disti_paper_level *level)
{
    size_t count = 0, queries;
    for (size_t i = 0; i < level->n; i++) {
        if (bench->rays[i].mode != DISTI_DONE || bench->rays[i].status != DIST_RAY_INSIDE) continue;
        disti_ray_point(&bench->rays[i], bench->rays[i].enter, bench->points + 3 * count);
        bench->index[count++] = (int)i;
    }
    int asks = tracer->how.paper_row == DIST_PAPER_COARSE_TO_FINE;
    queries = asks && count > 0 ? disti_query(tracer, worker, bench, count) : 0;
    bench->stats->march_queries += queries;
    for (size_t k = 0; k < count; k++) {
        disti_ray *ray = &bench->rays[bench->index[k]];
        float f = k < queries ? bench->sdf[k] : ray->a.f;
        disti_ray_end(ray, DIST_RAY_INSIDE, ray->enter, f, 0.0f);
        if (!level->samples) continue;
        float *samples = disti_paper_samples(tracer, level, (size_t)bench->index[k]);
        for (int j = 0; j < tracer->how.samples; j++) samples[4 * j] = j == 0 ? f : 3e38f;
        memcpy(samples + 1, bench->points + 3 * k, 3 * sizeof(float));
    }
}

/* Traces one tile. samples (rays, how.samples, 4) may be NULL; it is written for every ray. */
static void disti_paper_trace(const disti_tracer *tracer, int worker, const disti_tile *tile, const disti_bench *bench,
                              float *samples, size_t samples_stride)
{
    size_t n = (size_t)(tile->width * tile->height);
    int row = tracer->how.paper_row, steps = tracer->how.max_steps;
    if (bench->budget && bench->budget->per_hit > 0) /* what all rays would owe, but at most half of it */
        bench->budget->hits = DISTI_MIN((unsigned long long)n, bench->budget->left / 2 / bench->budget->per_hit);
    disti_paper_level level = {bench->rays, samples, n, (size_t)tile->width, samples_stride};
    disti_paper_clear(tracer, &level);
    if (row == DIST_PAPER_COARSE_TO_FINE) {
        enum { QUARTER = 64, HALF = 256 }; /* rays at most, of the tiles of this tracer */
        disti_ray *rays = (disti_ray *)(void *)bench->rest;
        float *kept = samples ? (float *)(void *)(rays + QUARTER + HALF) : NULL;
        disti_paper_level quarter = {rays, kept, 0, 0, 0}, half = {rays + QUARTER, kept, 0, 0, 0};
        if (kept) half.samples += QUARTER * 4 * tracer->how.samples;
        disti_paper_coarse(tracer, worker, tile, bench, 4, NULL, &quarter);
        disti_paper_coarse(tracer, worker, tile, bench, 2, &quarter, &half);
        disti_paper_inherit(tracer, &half, &level);
        steps = DISTI_MAX(steps - 6, 1);
    }
    for (int step = 0; step < steps; step++) {
        size_t count = disti_paper_march(tracer, worker, bench, &level, step == 0 || row == DIST_PAPER_PARALLEL);
        if (count == 0) break;
        bench->stats->march_queries += count;
    }
    for (size_t i = 0; i < n; i++)
        if (bench->rays[i].mode != DISTI_DONE) disti_paper_finish(tracer, &bench->rays[i]);
    disti_paper_inside(tracer, worker, bench, &level);
    disti_trace_end(tracer, bench, n);
}
#endif

/*@ 08 render ------------------------------------------------------------------------------------------------------- */

enum { DISTI_RUN = (int)DISTI_SLOTS * DISTI_BLOCK }; /* pixels whose colors and normals go back at once */

/* One point of the backward pass. */
typedef struct disti_entry {
    float d_distance;   /* dL/d(distance along the ray), field units */
    float d_motion;     /* the same from what is seen there, normal and color: not weighted */
    float d_sdf;        /* dL/df at this point from elsewhere: silhouette, the paper's samples */
    float d_depth;      /* dL/d(depth), which the ray's tilt alone changes too */
    float direction[3]; /* of the ray, field space */
    float weight;       /* of d_distance and d_depth: |n . v| in the normal mode, 1 else */
    unsigned char capped;
    unsigned char edge; /* 1: where the ray enters or leaves the bounding sphere, and moves with it */
} disti_entry;

/* distance and status: written by dist_render, read by the backward pass. samples: the paper's K (f and point),
   likewise. The rest is the backward pass's work space. */
struct dist_tape {
    dist_context *ctx;
    int width, height, trace, samples;
    float *s; /* (pixels): hit, or sample of smallest |f|, measured from the closest approach to the center */
    unsigned char *status;  /* (pixels): DIST_RAY_*, with DISTI_TAPE_* bits */
    float *sample;          /* (pixels, samples, 4), paper's tracer only */
    /* (pixels), warm start only: slope at a hit, |f| at a miss; where the cones stopped; disti_nearest_task's, and what
       f is not below from there on as far as disti_warm_beside looked, but where a miss's |f| is least */
    float *value, *start, *nearest, *beside;
    float *owed;            /* (pixels), likewise: by how much a hit may be off that was moved unasked; 0: asked */
    disti_cone *cones;      /* warm start: all of the picture, asked for beside those of other tiles */
    unsigned turn;          /* warm renders so far */
    unsigned *cost;         /* of the last picture's tiles: queries */
    int *order;             /* of the tiles: first those that cost most then */
    int tiled;              /* the size of these tiles; 0: there are none */
    int rendered, has_silhouette;
    unsigned changes, color_changes; /* disti_changes of its field then, and the like of its color */
    dist_field field;
    dist_camera camera;
    disti_tracer tracer;
    disti_entry *entry;     /* DISTI_CHUNK */
    float *points, *d_sdf, *d_points; /* (DISTI_CHUNK, 3), 1, 3 */
    float *hit, *d_color, *pull, *bend; /* (DISTI_RUN, 3): hits, dL/dcolor, dL/dpoint by color and by normal */
    void *memory;           /* holds all of these */
    size_t bytes;
};

/* counts as a hit; has a sample of smallest |f|; misses by less than how.relax_band; no hit, but that sample's f < 0 */
enum { DISTI_TAPE_HIT = 16, DISTI_TAPE_SAMPLE = 32, DISTI_TAPE_NEAR = 64, DISTI_TAPE_SOLID = 128 };

/* The most cones that do not fall apart in a tile of this size, blocks of 8 pixels or larger, and one of size 0; those
   of a picture, whatever its tiles. */
static int disti_tile_cones(int tile)
{
    int across = (tile + (int)DISTI_LATTICE - 1) / (int)DISTI_LATTICE;
    return across * across + 1;
}

/* The smallest tiles of a picture, the paper's tracer's apart: it should have some for every worker. */
static int disti_tile_least(int width, int height)
{
    return (double)width * (double)height < 256.0 * 256.0 ? (int)DISTI_TILE_USUAL / 2 : (int)DISTI_TILE_USUAL;
}

static size_t disti_picture_cones(int width, int height)
{
    const int tiles[3] = {(int)DISTI_TILE_USUAL / 2, (int)DISTI_TILE_USUAL, (int)DISTI_TILE};
    size_t most = 0;
    for (int i = 0; i < 3; i++) {
        int t = tiles[i];
        size_t count = (size_t)((width + t - 1) / t) * (size_t)((height + t - 1) / t) * (size_t)disti_tile_cones(t);
        most = DISTI_MAX(most, count);
    }
    return most;
}

/* Returns the bytes needed; base NULL: only that. warm: also what the next picture starts from. */
static size_t disti_tape_layout(dist_tape *tape, unsigned char *base, int warm)
{
    size_t at = 0, pixels = (size_t)tape->width * (size_t)tape->height, each = DISTI_CHUNK, three = 3 * sizeof(float);
    tape->s = (float *)disti_take(base, &at, pixels, sizeof(float));
    tape->status = (unsigned char *)disti_take(base, &at, pixels, 1);
    if (tape->trace == DIST_TRACE_PAPER)
        tape->sample = (float *)disti_take(base, &at, pixels, (size_t)tape->samples * 4 * sizeof(float));
    float **kept[5] = {&tape->value, &tape->start, &tape->nearest, &tape->beside, &tape->owed};
    for (int i = 0; i < 5 && warm; i++) *kept[i] = (float *)disti_take(base, &at, pixels, sizeof(float));
    if (warm) {
        size_t cones = disti_picture_cones(tape->width, tape->height);
        tape->cones = (disti_cone *)disti_take(base, &at, cones, sizeof(disti_cone));
    }
    int tile = disti_tile_least(tape->width, tape->height);
    size_t tiles = (size_t)((tape->width - 1) / tile + 1) * (size_t)((tape->height - 1) / tile + 1);
    tape->cost = (unsigned *)disti_take(base, &at, tiles, sizeof(unsigned));
    tape->order = (int *)disti_take(base, &at, tiles, sizeof(int));
    tape->entry = (disti_entry *)disti_take(base, &at, each, sizeof(disti_entry));
    tape->points = (float *)disti_take(base, &at, each, three);
    tape->d_sdf = (float *)disti_take(base, &at, each, sizeof(float));
    tape->d_points = (float *)disti_take(base, &at, each, three);
    float **run[4] = {&tape->hit, &tape->d_color, &tape->pull, &tape->bend};
    for (int i = 0; i < 4; i++) *run[i] = (float *)disti_take(base, &at, DISTI_RUN, three);
    return at;
}

DIST_API void dist_tape_destroy(dist_tape *tape)
{
    if (!tape) return;
    disti_free(tape->ctx, tape->memory, tape->bytes);
    disti_free(tape->ctx, tape, sizeof *tape);
}

/* The memory of a tape for a camera and settings that have been checked, but for its own. */
static dist_status disti_tape_take(dist_context *ctx, dist_tape *tape, const dist_camera *camera,
                                   const dist_render_desc *desc)
{
    dist_render_desc how = dist_render_desc_resolve(desc);
    memset(tape, 0, sizeof *tape);
    tape->ctx = ctx;
    tape->width = camera->width;
    tape->height = camera->height;
    tape->trace = how.trace;
    tape->samples = how.samples;
    dist_status status = disti_partial_reserve(ctx, 1024); /* for codes of fields that are not nets */
    if (status != DIST_OK) return status;
    size_t pixels, all, each = 5 + (how.warm_start ? 24u : 0u) + (how.trace == DIST_TRACE_PAPER ? 128u : 0u);
    int fits = disti_size_mul((size_t)tape->width, (size_t)tape->height, &pixels) && disti_size_mul(pixels, each, &all);
    tape->bytes = fits && all < (size_t)-1 / 2 ? disti_tape_layout(tape, NULL, how.warm_start) : (size_t)-1;
    tape->memory = disti_alloc(ctx, tape->bytes);
    return tape->memory ? DIST_OK : DIST_OUT_OF_MEMORY;
}

static dist_status disti_tape_check(dist_context *ctx, const dist_camera *camera, const dist_render_desc *desc)
{
    dist_status status = disti_camera_check(ctx, camera, "dist_tape_create");
    return status == DIST_OK ? disti_how_check(ctx, desc, "dist_tape_create") : status;
}

DIST_API dist_tape *dist_tape_create(dist_context *ctx, const dist_camera *camera, const dist_render_desc *desc)
{
    if (disti_enter(ctx, "dist_tape_create") != DIST_OK || disti_tape_check(ctx, camera, desc) != DIST_OK) return NULL;
    dist_tape *tape = (dist_tape *)disti_alloc(ctx, sizeof(dist_tape));
    if (!tape) return NULL;
    if (disti_tape_take(ctx, tape, camera, desc) != DIST_OK) {
        dist_tape_destroy(tape);
        return NULL;
    }
    disti_tape_layout(tape, (unsigned char *)tape->memory, desc ? desc->warm_start : 0);
    return tape;
}

static void disti_pixel_ray(const disti_view *view, const dist_field *field, size_t pixel, disti_ray *ray)
{
    double local[3], world[3];
    size_t width = (size_t)view->width;
    disti_view_direction(view, (double)(pixel % width), (double)(pixel / width), local);
    disti_rotate_back(view->rotation, local, world);
    disti_ray_init(field, view->center, world, disti_view_footprint(view, local[2]), ray);
    ray->cosine = (float)local[2];
}

enum { DISTI_LIST_TASKS = 256, DISTI_LIST_RAYS = 4096 };

typedef struct disti_render_job {
    const disti_tracer *tracer;
    const disti_view *view;
    const dist_images *out;
    dist_tape *tape;
    int tile, across;
    int lattice; /* disti_tile's; 0: pixels do not start from what their neighbors found */
    int least;   /* misses need their smallest f: for the silhouette or the relaxed boundary */
    int warm;    /* and from what the tape's picture found */
    int coned;   /* the cones stand in the tape */
    int lazy;    /* nothing is wanted of rays that miss */
    int cheap;   /* and a query costs so little that it is asked sooner than a ray looks for balls */
    float step;  /* three pixels' width at the field's center */
    float change; /* mean change of f at the tape's hits */
    size_t first[DISTI_LIST_TASKS + 1]; /* disti_render_list: first pixel of each task */
    size_t each;                        /* and how many of them each has */
    int count;                          /* tasks */
    const int *order;                   /* NULL: the tiles as they stand */
    unsigned *cost;                     /* NULL, or what each tile costs goes here */
    int box[4];  /* left, top, right, bottom: pixels that may see the bounding sphere */
} disti_render_job;

/* How far the sphere (center c in camera space) reaches in units of tan, times focal: k with |a - k c_z| <= radius
   sqrt(focal^2 + k^2), the planes through the camera that meet it, a = focal times its own tan times c_z. */
static void disti_sphere_reach(double a, double focal, double depth, double radius, double first, int side, int *low,
                               int *high)
{
    double square = depth * depth - radius * radius;
    *low = 0;
    *high = side;
    if (!(depth > radius) || !(square > 0.0)) return;
    double root = radius * sqrt(a * a + focal * focal * square);
    double least = first + (a * depth - root) / square - 1.0, most = first + (a * depth + root) / square + 2.0;
    *low = (int)DISTI_MIN(DISTI_MAX(least, 0.0), (double)side);
    *high = (int)DISTI_MIN(DISTI_MAX(most, (double)*low), (double)side);
}

static void disti_sphere_box(const disti_view *view, const dist_field *field, int box[4])
{
    double c[3], away[3], radius = (double)field->radius;
    for (int i = 0; i < 3; i++) away[i] = (double)field->center[i] - view->center[i];
    disti_rotate(view->rotation, away, c);
    disti_sphere_reach(view->fx * c[0] + view->skew * c[1], sqrt(view->fx * view->fx + view->skew * view->skew), c[2],
                       radius, view->cx - view->first, view->width, &box[0], &box[2]);
    disti_sphere_reach(view->fy * c[1], view->fy, c[2], radius, view->cy - view->first, view->height, &box[1], &box[3]);
}

static double disti_overlap(int low, int high, int first, int end)
{
    return (double)DISTI_MAX(0, DISTI_MIN(high, end) - DISTI_MAX(low, first));
}

static void disti_budget_init(const disti_render_job *job, double before, double mine, double all, disti_budget *budget)
{
    memset(budget, 0, sizeof *budget);
    budget->left = all > 0.0 ? disti_share(job->tracer, before + mine, all) - disti_share(job->tracer, before, all) : 0;
    if (job->out->normal) budget->per_hit += job->tracer->how.normal_mode == DIST_NORMAL_ANALYTIC ? 1 : 6;
    budget->per_hit += job->out->color != NULL;
}

/* The tile's share: pixels in the box, counted through the tiles in their order. */
static void disti_render_budget(const disti_render_job *job, const disti_tile *tile, disti_budget *budget)
{
    const int *box = job->box;
    double wide = (double)(box[2] - box[0]), rows = disti_overlap(box[1], box[3], tile->y, tile->y + tile->height);
    double before = wide * disti_overlap(box[1], box[3], 0, tile->y) +
                    rows * disti_overlap(box[0], box[2], 0, tile->x);
    double mine = rows * disti_overlap(box[0], box[2], tile->x, tile->x + tile->width);
    disti_budget_init(job, before, mine, wide * (double)(box[3] - box[1]), budget);
}

/* Gradients of f at up to DISTI_GRADIENTS hit points at a time. */
enum { DISTI_GRADIENTS = 1024 };

/* normal    analytic: G = grad f;  difference: G_i = (f(p + delta e_i) - f(p - delta e_i)) / (2 delta);  n = G / |G|
   Writes G for n points, the analytic one in one pass, differences in six queries a point; 0 where it is not finite. */
static void disti_normal_gradient(const disti_tracer *tracer, int worker, const disti_bench *bench, size_t n,
                                  const float *points, float *gradient)
{
    const dist_field *field = tracer->field;
    if (tracer->how.normal_mode == DIST_NORMAL_ANALYTIC) {
        field->eval_fn(field->user, worker, n, points, bench->sdf, gradient);
        bench->stats->normal_queries += n;
        bench->stats->queries += n;
    } else {
        float delta = tracer->how.normal_delta;
        memset(gradient, 0, 3 * n * sizeof(float));
        for (int side = 0; side < 6; side++) {
            float shift = side & 1 ? -delta : delta, *moved = bench->points;
            memcpy(moved, points, 3 * n * sizeof(float));
            for (size_t i = 0; i < n; i++) moved[3 * i + (size_t)(side / 2)] += shift;
            field->eval_fn(field->user, worker, n, moved, bench->sdf, NULL);
            for (size_t i = 0; i < n; i++) gradient[3 * i + (size_t)(side / 2)] += bench->sdf[i] / (2.0f * shift);
        }
        bench->stats->normal_queries += 6 * n;
        bench->stats->queries += 6 * n;
    }
    for (size_t i = 0; i < n; i++)
        if (!disti_finite_all(3, gradient + 3 * i)) gradient[3 * i] = gradient[3 * i + 1] = gradient[3 * i + 2] = 0.0f;
}

static void disti_render_normal(const disti_render_job *job, const disti_tile *tile, int index, const float *gradient)
{
    double g[3] = {(double)gradient[0], (double)gradient[1], (double)gradient[2]}, normal[3];
    if (!disti_normalize(g)) return;
    if (job->tracer->how.normal_space == DIST_SPACE_WORLD) memcpy(normal, g, sizeof normal);
    else disti_rotate(tile->view->rotation, g, normal);
    float *to = job->out->normal + 3 * disti_tile_pixel(tile, index);
    for (size_t axis = 0; axis < 3; axis++) to[axis] = (float)normal[axis];
}

/* Normals of the tile's hits, `hits` rays listed in bench->index. */
static void disti_render_normals(const disti_render_job *job, int worker, const disti_tile *tile,
                                 const disti_bench *bench, size_t hits)
{
    float *points = (float *)(void *)bench->rest + 6 * DISTI_TILE_RAYS, *gradient = points + 3 * DISTI_GRADIENTS;
    for (size_t i = 0, from = 0; i < hits; from = i) {
        size_t count = 0;
        for (; i < hits && count < DISTI_GRADIENTS; i++) {
            const disti_ray *ray = &bench->rays[bench->index[i]];
            if (ray->own) disti_render_normal(job, tile, bench->index[i], disti_bench_gradient(bench, bench->index[i]));
            else disti_ray_point(ray, ray->best, points + 3 * count++);
        }
        if (count > 0) disti_normal_gradient(job->tracer, worker, bench, count, points, gradient);
        for (count = 0; from < i; from++)
            if (!bench->rays[bench->index[from]].own)
                disti_render_normal(job, tile, bench->index[from], gradient + 3 * count++);
    }
}

static void disti_render_colors(const disti_render_job *job, int worker, const disti_tile *tile,
                                const disti_bench *bench, size_t hits)
{
    const dist_field *field = job->tracer->field;
    float *points = (float *)(void *)bench->rest, *color = points + 3 * DISTI_GRADIENTS;
    for (size_t i = 0, count; i < hits; i += count) {
        const int *index = bench->index + i;
        count = DISTI_MIN(hits - i, (size_t)DISTI_GRADIENTS);
        for (size_t k = 0; k < count; k++)
            disti_ray_point(&bench->rays[index[k]], bench->rays[index[k]].best, points + 3 * k);
        field->color_fn(field->user, worker, count, points, color);
        bench->stats->queries += count;
        bench->stats->color_queries += count;
        for (size_t k = 0; k < count; k++) {
            size_t pixel = disti_tile_pixel(tile, index[k]);
            for (size_t c = 0; c < 3; c++) /* a net may overflow */
                job->out->color[3 * pixel + c] =
                    disti_finite(color[3 * k + c]) ? color[3 * k + c] : job->tracer->how.background_color[c];
        }
    }
}

/* Point of a ray off the bounding sphere that is nearest to it: the closest approach or, where that lies behind the
   camera, the camera. Returns its distance from the sphere's center; away: the way from there, as long. */
static double disti_ray_nearest(const dist_field *field, const disti_ray *ray, double point[3], double away[3])
{
    for (int i = 0; i < 3; i++) {
        point[i] = (double)ray->origin[i] - DISTI_MIN(ray->base, 0.0) * (double)ray->direction[i];
        away[i] = point[i] - (double)field->center[i];
    }
    return sqrt(disti_dot(away, away));
}

/* Value of the soft silhouette of a finished ray: |f|, of the paper's hits and of hits inside signed, less epsilon; off
   the sphere the ray's distance to it. The sign says hit or miss whatever rounding did. */
static float disti_ray_silhouette(const disti_tracer *tracer, const disti_ray *ray)
{
    const dist_field *field = tracer->field;
    float tiny = 1e-3f * tracer->noise;
    if (ray->enter >= ray->leave) {
        double nearest[3], away[3];
        float off = disti_within_float(disti_ray_nearest(field, ray, nearest, away) - (double)field->radius);
        return DISTI_MIN(DISTI_MAX(off, tiny), 3e38f);
    }
    float f = ray->fbest, magnitude = f < 0.0f ? -f : f;
    float epsilon = disti_ray_epsilon(tracer, ray, ray->best);
    if (ray->status == DIST_RAY_NOT_FINITE) return epsilon;
    int is_signed = tracer->how.trace == DIST_TRACE_PAPER || ray->status == DIST_RAY_INSIDE;
    if (disti_ray_is_hit(tracer, ray)) return DISTI_MIN((is_signed ? f : magnitude) - epsilon, -tiny);
    if (magnitude > 2e38f) /* no sample: no more is known than this bound */
        return (float)DISTI_MIN((double)tracer->lipschitz * (double)field->radius, 3e38);
    return DISTI_MAX(magnitude - epsilon, tiny);
}

/* All planes of one pixel but its normal and color, which hits get later. */
static void disti_render_pixel(const disti_render_job *job, const disti_ray *ray, size_t pixel)
{
    const disti_tracer *tracer = job->tracer;
    const dist_images *out = job->out;
    int hit = disti_ray_is_hit(tracer, ray), skipped = ray->status == DIST_RAY_SKIPPED;
    int placed = hit || ray->status == DIST_RAY_UNRESOLVED;
    double distance = disti_ray_along(ray);
    if (out->depth) out->depth[pixel] = placed ? (float)(distance * (double)ray->cosine) : tracer->how.background;
    if (out->distance) out->distance[pixel] = placed ? (float)distance : tracer->how.background;
    if (out->silhouette) out->silhouette[pixel] = skipped ? 0.0f : disti_ray_silhouette(tracer, ray);
    if (out->mask) out->mask[pixel] = (unsigned char)hit;
    if (out->status) out->status[pixel] = ray->status;
    if (out->error) out->error[pixel] = placed ? disti_ray_bound(tracer, ray) : 0.0f;
    if (out->normal) out->normal[3 * pixel] = out->normal[3 * pixel + 1] = out->normal[3 * pixel + 2] = 0.0f;
    if (out->color) memcpy(out->color + 3 * pixel, tracer->how.background_color, 3 * sizeof(float));
    if (!job->tape) return;
    int sampled = ray->enter < ray->leave && ray->fbest < 2e38f && ray->status != DIST_RAY_NOT_FINITE;
    float least = job->tape->sample ? job->tape->sample[pixel * (size_t)job->tape->samples * 4] : ray->fbest;
    job->tape->s[pixel] = ray->best;
    job->tape->status[pixel] = (unsigned char)(ray->status | (ray->status == DIST_RAY_HIT ? DISTI_TAPE_HIT : 0) |
                                               (sampled ? DISTI_TAPE_SAMPLE : 0) |
                                               (sampled && ray->status == DIST_RAY_MISS && ray->fbest > 0.0f &&
                                                        ray->fbest < job->tracer->how.relax_band
                                                    ? DISTI_TAPE_NEAR
                                                    : 0) |
                                               (sampled && !hit && least < 0.0f ? DISTI_TAPE_SOLID : 0));
    if (!job->tape->value) return;
    if (!ray->kept) job->tape->beside[pixel] = job->tape->owed[pixel] = 0.0f;
    job->tape->start[pixel] = ray->kept ? DISTI_MIN(job->tape->start[pixel], ray->stop) : ray->stop;
    /* a ray that was looking for the way out has no slope to start from */
    job->tape->value[pixel] = ray->status != DIST_RAY_HIT ? ray->fbest : ray->sign > 0.0f ? ray->slope : 0.0f;
}

DISTI_LOOPS static void disti_fill(size_t n, float value, float *plane)
{
    for (size_t i = 0; i < n; i++) plane[i] = value;
}

/* A run of pixels that see nothing and of which no silhouette and no tape wants to know more. */
static void disti_render_nothing(const disti_render_job *job, size_t pixel, size_t count)
{
    const dist_images *out = job->out;
    float background = job->tracer->how.background;
    if (out->depth) disti_fill(count, background, out->depth + pixel);
    if (out->distance) disti_fill(count, background, out->distance + pixel);
    if (out->mask) memset(out->mask + pixel, 0, count);
    if (out->status) memset(out->status + pixel, DIST_RAY_MISS, count);
    if (out->error) memset(out->error + pixel, 0, count * sizeof(float));
    if (out->normal) memset(out->normal + 3 * pixel, 0, 3 * count * sizeof(float));
    for (size_t i = 0; i < count && out->color; i++)
        memcpy(out->color + 3 * (pixel + i), job->tracer->how.background_color, 3 * sizeof(float));
}

/* A tile of which the cones leave nothing. */
static void disti_render_empty(const disti_render_job *job, const disti_tile *tile, const disti_bench *bench)
{
    for (int y = 0; y < tile->own_height; y++)
        disti_render_nothing(job, disti_tile_pixel(tile, y * tile->width), (size_t)tile->own_width);
    bench->stats->rays += (unsigned long long)tile->own_width * (unsigned long long)tile->own_height;
}

/* The pixels of a tile; its hits are listed in bench->index for what only they have. */
static void disti_render_planes(const disti_render_job *job, int worker, const disti_tile *tile,
                                const disti_bench *bench)
{
    int plain = !job->out->silhouette && !job->tape && !tile->list;
    size_t hits = 0;
    for (int y = 0; y < tile->own_height; y++) {
        const disti_ray *ray = bench->rays + y * tile->width;
        size_t first = tile->list ? 0 : disti_tile_pixel(tile, y * tile->width);
        for (int x = 0; x < tile->own_width;) {
            size_t pixel = tile->list ? tile->list[x] : first + (size_t)x, count = 0;
            for (; plain && x < tile->own_width && ray->status == DIST_RAY_MISS; x++, ray++, count++)
                if (!tile->lazy) bench->stats->rays_in_sphere += ray->enter < ray->leave; /* else they have been */
            bench->stats->rays += count;
            if (count > 0) disti_render_nothing(job, pixel, count);
            if (count > 0) continue;
            if (disti_ray_is_hit(job->tracer, ray)) bench->index[hits++] = y * tile->width + x;
            disti_stats_ray(job->tracer, ray, bench->stats);
            disti_render_pixel(job, ray++, pixel);
            x++;
        }
    }
    if (job->out->normal) disti_render_normals(job, worker, tile, bench, hits);
    if (job->out->color) disti_render_colors(job, worker, tile, bench, hits);
}

/* Adds the pixels whose rays meet the bounding sphere: with b = c . d and k = |c|^2 - radius^2 those with b < 0 and
   b^2 > k |d|^2, or all from within it; c: the camera, from the center; d = (u, v, 1), rotated to the world. They are a
   run of the row's (the sphere's picture is convex), so all are if both ends are. */
DISTI_LOOPS static unsigned disti_row_meets(int n, double first, double scale, double b0, double b1, double w, double k)
{
    unsigned count = 0;
    for (int i = 0, step = DISTI_MAX(n - 1, 1); i < n; i += step) {
        double u = (first + (double)i) * scale, b = b0 + b1 * u;
        count += (b < 0.0) & (b * b > k * (u * u + w));
    }
    if (count == 2) return (unsigned)n;
    count = 0;
    for (int i = 0; i < n; i++) {
        double u = (first + (double)i) * scale, b = b0 + b1 * u;
        count += (b < 0.0) & (b * b > k * (u * u + w));
    }
    return count;
}

static void disti_render_meets(const disti_render_job *job, const disti_tile *tile, dist_stats *stats)
{
    const disti_view *view = job->view;
    const dist_field *field = job->tracer->field;
    double c[3], local[3];
    int low = DISTI_MAX(tile->x, job->box[0]), high = DISTI_MIN(tile->x + tile->own_width, job->box[2]);
    int top = DISTI_MAX(tile->y, job->box[1]), bottom = DISTI_MIN(tile->y + tile->own_height, job->box[3]);
    for (int i = 0; i < 3; i++) c[i] = view->center[i] - (double)field->center[i];
    disti_rotate(view->rotation, c, local);
    double k = disti_dot(c, c) - (double)field->radius * (double)field->radius;
    for (int y = top; y < bottom && low < high; y++) {
        double v = ((double)y + view->first - view->cy) / view->fy;
        if (k <= 0.0) stats->rays_in_sphere += (unsigned)(high - low);
        else stats->rays_in_sphere += disti_row_meets(high - low, (double)low + view->first - view->cx - view->skew * v,
                                                      1.0 / view->fx, local[1] * v + local[2], local[0], v * v + 1.0,
                                                      k);
    }
}

/* Drops the extra column and row: what follows is about the tile's own pixels. */
static void disti_tile_trim(const disti_render_job *job, disti_tile *tile, const disti_bench *bench)
{
    int w = tile->width, keeps = job->least || job->tape;
    for (int y = 0; y < tile->own_height && w != tile->own_width; y++) {
        disti_ray *row = bench->rays + y * w;
        if (keeps) memmove(bench->rays + y * tile->own_width, row, (size_t)tile->own_width * sizeof(disti_ray));
        else disti_ray_skip(row + w - 1); /* and the rows stay where they are */
    }
    if (keeps) tile->width = tile->own_width;
    tile->height = tile->own_height;
}

/* Warm start: a tile begins with what the tape's picture shows of it.

   Hits. Every 8th pixel is looked for at its last distance; how far each moved, interpolated, predicts where the others
   are. A quarter of them takes one query there (a step of Newton's with the last slope ends it, as for a cold
   prediction), or a quarter of those where the corners around moved alike to within epsilon; the others lie between
   such that moved alike, and are moved with them, else they take a query, too. The quarters take turns, so no error
   lives longer than 15 turns. What Newton's steps do not end is bracketed, or marches on from there.
   Misses. Where the cones stopped again, the least |f| is known to within what the change of f at the hits around takes
   off it each turn (disti_warm_loss), or with a silhouette to within what disti_warm_drifts interpolates. Once that
   may have brought it near, f is asked for where it was least, and when it is near, by samples on both sides how low it
   is now: a crossing is bracketed on the spot, what stays undecided is marched. Without a silhouette these wait a few
   turns where f has hardly changed, as on a plateau near 0.
   What has a nearer hit beside it, not of the same slant, may be covered by that: from the nearer one's distance on,
   the least f is looked for likewise, again when the bound found is used up; misses take turns at it, and hits while
   the picture moves little.
   Rays that start inside do so until the change of f may have brought them out.
   All is off for rays where f at the cones' stop is too small for the surface expected (as in disti_predict) and the
   cones prove less to be empty than when the ray was traced, for tiles where the first pixels contradict what is
   expected, and around those of the pixels marched anew (one hit in 128 each turn, down to one in 512) that do; a hit
   marched anew is verified as the others are once nothing nearer can be in its way. */
enum { DISTI_WARM_HITS = 128, DISTI_WARM_MISSES = 64, DISTI_WARM_MINIMA = 8 };

/* What a ray is asked for: a step of Newton's, how f has changed where it was least, whether that is still a miss (the
   next stage waits for these three), spheres beside a nearer surface, how close it passes by one, anew, and anew to see
   whether that is where it was expected (known: it has been, or marches on from where it was looked for). */
enum {
    DISTI_ASK_NOTHING,
    DISTI_ASK_NEWTON,
    DISTI_ASK_DRIFT,
    DISTI_ASK_LEAST,
    DISTI_ASK_BESIDE,
    DISTI_ASK_NEAR,
    DISTI_ASK_MARCH,
    DISTI_ASK_REFRESH,
    DISTI_ASK_KNOWN
};

typedef struct disti_warm {
    dist_tape *tape;
    const disti_tracer *tracer;
    const disti_tile *tile;
    const disti_bench *bench;
    int worker, n, silhouette;
    float *moved;         /* of each pixel: how far its hit has moved; 3e38: not known */
    float *drift;         /* of each miss that was asked: how its least f has changed; 3e38: not known */
    unsigned char *open;  /* 1: not decided by the cones; 2: and its hit was not where it was looked for */
    unsigned char *ask;   /* DISTI_ASK_* */
    unsigned char *row;   /* of the tile: i / width */
    float change;         /* largest change of f in the tile, no less than its mean over the picture */
    float typical;        /* mean change of f at every 8th hit */
    unsigned calm;        /* disti_warm_calm */
    int due, late;        /* all least |f| are looked for anew; neighbors are known as far as they will be */
    size_t count, awaited; /* of bench->index; of these, with the first three DISTI_ASK_* */
} disti_warm;

static int disti_warm_y(const disti_warm *warm, int i) { return warm->row[i]; }

static int disti_warm_x(const disti_warm *warm, int i) { return i - warm->row[i] * warm->tile->width; }

static size_t disti_warm_pixel(const disti_warm *warm, int i)
{
    const disti_tile *tile = warm->tile;
    size_t x = (size_t)(tile->x + disti_warm_x(warm, i)), y = (size_t)(tile->y + disti_warm_y(warm, i));
    return y * (size_t)tile->view->width + x;
}

/* How much rarer than after `period` turns pixels are marched anew, 1 to 4: what may come up unseen grows with what the
   picture moves, on average. */
static unsigned disti_warm_calm(float change, float radius)
{
    unsigned calm = 1;
    while (calm < 4 && (float)(2 * calm * DISTI_WARM_HITS) * change <= 0.1f * radius) calm *= 2;
    return calm;
}

/* Whether it is the pixel's turn to be marched anew: one of each 8 x 16 block (period 128), scattered, up to one of
   each 16 x 32; no later than that where `calm` changes meanwhile. */
static int disti_warm_due(const disti_warm *warm, int i, unsigned period)
{
    unsigned x = (unsigned)disti_warm_x(warm, i), y = (unsigned)disti_warm_y(warm, i);
    unsigned place = x % 8u + y % 16u * 8u + x / 8u % 2u * 128u + y / 16u % 2u * 256u;
    return (place * 27u + warm->tape->turn) % (period * warm->calm) == 0;
}

/* Whether the cones prove the ray empty as far as when it was traced, with the last sphere beyond their stop. */
static int disti_warm_reaches(const disti_warm *warm, int i)
{
    const disti_ray *ray = &warm->bench->rays[i];
    return ray->start + ray->guard / warm->tracer->lipschitz >= warm->tape->start[disti_warm_pixel(warm, i)];
}

/* A hit where f falls less steeply than this is not looked for. */
static float disti_warm_flat(const disti_warm *warm)
{
    return -2e-4f * warm->tracer->lipschitz;
}

/* Whether f crossed 0 at the ray's last hit by falling, not all but flat, nor by a step, as where a solid that goes on
   beyond its bounding sphere is cut off: that does not move with what is around it. */
static int disti_warm_falls(const disti_warm *warm, size_t pixel)
{
    float slope = warm->tape->value[pixel];
    return slope < disti_warm_flat(warm) && slope > -4.0f * warm->tracer->lipschitz;
}

/* Whether the ray may be looked for near its last hit s. */
static int disti_warm_expects(const disti_warm *warm, int i, float s)
{
    size_t pixel = disti_warm_pixel(warm, i);
    const disti_ray *ray = &warm->bench->rays[i];
    float slope = warm->tape->value[pixel];
    if (warm->open[i] != 1 || ray->mode == DISTI_DONE || (warm->tape->status[pixel] & 15) != DIST_RAY_HIT) return 0;
    if (!disti_warm_falls(warm, pixel) || !(s > ray->enter && s < ray->leave)) return 0;
    if (ray->guard > 2e38f) return 0; /* no cone came here */
    return -slope * (s - ray->start) <= ray->guard || disti_warm_reaches(warm, i);
}

/* What ends this much nearer than expected is another surface. */
static float disti_warm_far(const disti_warm *warm)
{
    return 0.01f * warm->tracer->field->radius + 4.0f * warm->change;
}

static void disti_warm_change(disti_warm *warm, float change)
{
    warm->change = DISTI_MAX(warm->change, change < 0.0f ? -change : change);
}

/* Lists ray i to be asked at q. */
static void disti_warm_list(disti_warm *warm, int i, int ask, float q)
{
    warm->bench->rays[i].q = q;
    warm->ask[i] = (unsigned char)ask;
    warm->bench->index[warm->count++] = i;
    warm->awaited += ask <= DISTI_ASK_LEAST;
}

/* Ray i is to be traced anew; once its neighbors are known at once and from what they found: 1. */
static int disti_warm_again(disti_warm *warm, int i)
{
    disti_ray *ray = &warm->bench->rays[i];
    ray->status = DIST_RAY_MISS;
    ray->mode = DISTI_FIRST;
    ray->best = ray->q = ray->start;
    ray->fbest = 3e38f;
    ray->front.f = ray->crept.f = ray->a.f = ray->b.f = ray->slope = ray->error = 0.0f;
    ray->steps = 0;
    ray->kept = 0;
    warm->bench->depth[i] = 0.0f;
    warm->moved[i] = 3e38f;
    warm->open[i] = 2;
    warm->ask[i] = DISTI_ASK_MARCH;
    if (!warm->late) return 0;
    return disti_predict(warm->tracer, warm->tile, warm->bench, disti_warm_x(warm, i), disti_warm_y(warm, i), 1);
}

/* Ray i goes on as if it had been marched to s, where f was found. */
static int disti_warm_resume(disti_warm *warm, int i, float s, float f)
{
    disti_ray *ray = &warm->bench->rays[i];
    disti_warm_again(warm, i);
    warm->ask[i] = DISTI_ASK_KNOWN;
    ray->q = s;
    if (disti_ray_advance(warm->tracer, ray, f)) return 1;
    warm->bench->depth[i] = disti_hit_depth(ray);
    return 0;
}

/* The crossing of ray i lies between a and b, a.f > 0 >= b.f. */
static int disti_warm_crosses(disti_warm *warm, int i, disti_sample a, disti_sample b)
{
    disti_ray *ray = &warm->bench->rays[i];
    warm->ask[i] = DISTI_ASK_NEAR;
    ray->moved = 0;
    return disti_ray_open_bracket(warm->tracer, ray, a, b);
}

static void disti_warm_hit(disti_warm *warm, int i, float s, float f, float error)
{
    disti_ray *ray = &warm->bench->rays[i];
    disti_ray_end(ray, DIST_RAY_HIT, s, f, error);
    ray->kept = 1;
    warm->bench->depth[i] = disti_hit_depth(ray);
    warm->moved[i] = s - warm->tape->s[disti_warm_pixel(warm, i)];
}

/* The sample f of a step of Newton's, the first with the last slope, then with the ray's own. What does not end within
   four is bracketed if the last two differ in sign, else it marches on from here. */
static int disti_warm_newton(disti_warm *warm, int i, float f)
{
    disti_ray *ray = &warm->bench->rays[i];
    float far = 0.03f * warm->tracer->field->radius, flat = disti_warm_flat(warm);
    const disti_sample now = {ray->q, f}, before = ray->a;
    float epsilon = disti_ray_epsilon(warm->tracer, ray, now.s);
    int first = ray->steps++ == 0, steep;
    float slope = first ? ray->slope : (f - before.f) / (now.s - before.s), step = -f / slope;
    float length = step < 0.0f ? -step : step, moved = ray->q + step - warm->tape->s[disti_warm_pixel(warm, i)];
    int good = disti_finite(step) && slope < flat && length < far && moved < far && moved > -far &&
               (first || f * f < before.f * before.f) && ray->q + step > ray->enter;
    ray->a = now;
    ray->slope = slope;
    ray->q += step;
    steep = slope < -0.3f * warm->tracer->lipschitz;
    if (good && length <= (!first ? 12.0f : steep ? 8.0f : 4.0f) * epsilon) {
        disti_warm_hit(warm, i, ray->q, f, disti_newton_error(warm->tracer, epsilon, slope, length, 0));
        warm->tape->owed[disti_warm_pixel(warm, i)] = 0.0f;
        disti_warm_change(warm, moved * slope);
        return 0;
    }
    if (good && ray->steps < 4) return 1;
    if (!first && f > 0.0f && before.f <= 0.0f && before.s > now.s) return disti_warm_crosses(warm, i, now, before);
    if (!first && f <= 0.0f && before.f > 0.0f && before.s < now.s) return disti_warm_crosses(warm, i, before, now);
    return disti_warm_resume(warm, i, now.s, f);
}

/* Where f changes alike, hits move by that over their slopes: how much more i moves than k. Else (`slopes` 0) alike. */
static float disti_warm_slower(const disti_warm *warm, int slopes, int i, int k)
{
    const float *slope = warm->tape->value;
    return slopes ? slope[disti_warm_pixel(warm, k)] / slope[disti_warm_pixel(warm, i)] : 1.0f;
}

/* Interpolated from the corners of the pixel's 8 x 8 block, as far as they are known; *spread gets how much all four
   differ, 3e38 if one is not known. */
static float disti_warm_guess(const disti_warm *warm, const float *moved, int slopes, int i, float *spread)
{
    int width = warm->tile->width, height = warm->tile->height, known = 0;
    int x = disti_warm_x(warm, i), y = disti_warm_y(warm, i);
    float sum = 0.0f, weights = 0.0f, low = 3e38f, high = -3e38f;
    for (int k = 0; k < 4; k++) {
        int right = k & 1, down = k >> 1, cx = (x & ~7) + 8 * right, cy = (y & ~7) + 8 * down;
        if (cx >= width || cy >= height || moved[cy * width + cx] > 2e38f) continue;
        float weight = (float)((right ? x & 7 : 8 - (x & 7)) * (down ? y & 7 : 8 - (y & 7)));
        float move = moved[cy * width + cx] * disti_warm_slower(warm, slopes, i, cy * width + cx);
        sum += weight * move;
        weights += weight;
        low = DISTI_MIN(low, move);
        high = DISTI_MAX(high, move);
        known++;
    }
    *spread = known == 4 ? high - low : 3e38f;
    return weights > 0.0f ? sum / weights : 3e38f;
}

/* Where the quarter of the pixels begins that is asked this turn: two bits, the offset along x and y. */
static unsigned disti_warm_phase(const disti_warm *warm)
{
    unsigned turn = warm->tape->turn & 3u;
    return turn ^ turn >> 1;
}

/* Whether the pixel is one of them. */
static int disti_warm_asks(const disti_warm *warm, int x, int y)
{
    unsigned phase = disti_warm_phase(warm);
    return ((unsigned)x & 1u) == (phase & 1u) && ((unsigned)y & 1u) == phase >> 1;
}

/* Mean of the moves of the pixels around that were asked, two beside it or four at its corners; *spread gets how much
   they differ, 3e38 if too few are known. */
static float disti_warm_between(const disti_warm *warm, const float *moves, int slopes, int i, float *spread)
{
    int width = warm->tile->width, height = warm->tile->height, known = 0, all = 0, border = 0;
    int x = disti_warm_x(warm, i), y = disti_warm_y(warm, i);
    float low = 3e38f, high = -3e38f, sum = 0.0f;
    for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
            if (!disti_warm_asks(warm, x + dx, y + dy)) continue;
            all++;
            if (x + dx < 0 || x + dx >= width || y + dy < 0 || y + dy >= height) {
                border = 1;
                continue;
            }
            float moved = moves[i + dy * width + dx];
            if (moved > 2e38f) continue;
            moved *= disti_warm_slower(warm, slopes, i, i + dy * width + dx);
            known++;
            low = DISTI_MIN(low, moved);
            high = DISTI_MAX(high, moved);
            sum += moved;
        }
    }
    float mean = known > 0 ? sum / (float)known : 3e38f, guess = 3e38f;
    if (border) guess = disti_warm_guess(warm, moves, slopes, i, spread);
    if (known > 0 && guess < 2e38f) {
        low = DISTI_MIN(low, guess);
        high = DISTI_MAX(high, guess);
    }
    *spread = known > 0 && (known >= (all == 2 ? 2 : 3) || guess < 2e38f) ? high - low : 3e38f;
    return mean;
}

/* Pixel i if it is a hit, in one of the passes of disti_warm_hits. */
static void disti_warm_look(disti_warm *warm, int i, int pass)
{
    size_t pixel = disti_warm_pixel(warm, i);
    float spread = 3e38f, wide = 3e38f, s = warm->tape->s[pixel], move = 0.0f;
    if (!disti_warm_falls(warm, pixel)) return; /* as disti_warm_expects */
    for (int slopes = 0; slopes < 2 && pass > 0; slopes++) { /* the one by which the neighbors differ less */
        float apart = 3e38f, *least = &spread, other = 3e38f;
        if (pass == 2) other = disti_warm_between(warm, warm->moved, slopes, i, &apart);
        if (apart > 2e38f && spread > 2e38f) {
            other = disti_warm_guess(warm, warm->moved, slopes, i, &apart);
            least = &wide;
        }
        if (slopes && !(apart < *least)) continue;
        move = other;
        *least = apart;
    }
    if (move > 2e38f) move = 0.0f;
    if (!disti_warm_expects(warm, i, s + move) || disti_warm_due(warm, i, DISTI_WARM_HITS)) return;
    disti_ray *ray = &warm->bench->rays[i];
    float epsilon = disti_ray_epsilon(warm->tracer, ray, s);
    ray->slope = warm->tape->value[pixel];
    unsigned other = (unsigned)(disti_warm_x(warm, i) / 2 + disti_warm_y(warm, i) / 2) + warm->tape->turn / 4u;
    if (pass == 1 && wide <= epsilon && other % 4u != 0) spread = wide;
    /* amid others at a crease; where the picture has hardly moved, those may have mended old errors of theirs */
    float unlike = DISTI_MAX(-3.0f * warm->typical / ray->slope, move < 0.0f ? -move : move);
    float within = ray->slope > -0.45f * warm->tracer->lipschitz ? 32.0f : 8.0f; /* what is flat may move alone */
    float *owed = &warm->tape->owed[pixel]; /* what it is off by stays until it is asked */
    if (!(spread <= 5.0f * epsilon)) {
        disti_warm_list(warm, i, DISTI_ASK_NEWTON, s + move);
        return;
    }
    *owed = DISTI_MAX(*owed, 2.0f * spread + unlike);
    disti_warm_hit(warm, i, s + move, 0.0f, (within - warm->tracer->lipschitz / ray->slope) * epsilon + *owed);
}

/* The hits: every 8th (pass 0), the quarter that is asked, the others, which have moved as those around have, or as f
   changed there over their own slope. */
static void disti_warm_hits(disti_warm *warm, int pass)
{
    int width = warm->tile->width, step = pass == 0 ? 8 : pass == 1 ? 2 : 1;
    unsigned phase = pass == 1 ? disti_warm_phase(warm) : 0;
    for (int y = (int)(phase >> 1); y < warm->tile->height; y += step)
        for (int x = (int)(phase & 1u); x < width; x += step)
            if (pass < 2 || !disti_warm_asks(warm, x, y)) disti_warm_look(warm, y * width + x, pass);
}

/* Whether a third of the `tried` first hits were found, and f has changed little there. */
static int disti_warm_good(disti_warm *warm, size_t tried)
{
    size_t good = 0;
    float sum = 0.0f;
    for (int i = 0; i < warm->n; i++) {
        if (warm->moved[i] > 2e38f) continue;
        float change = warm->moved[i] * warm->tape->value[disti_warm_pixel(warm, i)];
        sum += change < 0.0f ? -change : change;
        good++;
    }
    warm->typical = good > 0 ? sum / (float)good : 0.0f;
    return 3 * good >= tried && warm->typical <= 8e-3f * warm->tracer->field->radius;
}

/* Whether it is the tile's turn to have all of its least |f| looked for anew, in 2 to 8 turns: before the picture has
   moved by about half a hundredth of the radius, so that f where it was least is still the least to second order. */
static int disti_warm_minima_due(const disti_warm *warm)
{
    unsigned period = 2, x = (unsigned)warm->tile->x / DISTI_TILE, y = (unsigned)warm->tile->y / DISTI_TILE;
    float most = 2e-3f * warm->tracer->field->radius;
    while (period < DISTI_WARM_MINIMA && (float)period * warm->change < most) period *= 2;
    return !warm->tape->has_silhouette || (x * 5u + y * 3u + warm->tape->turn) % period == 0;
}

/* Whether a hit that a nearer surface may cover has come down to what it is itself, which is known. */
static int disti_warm_own(const disti_ray *ray)
{
    return ray->moved && ray->status == DIST_RAY_HIT && ray->front.s + ray->width >= ray->best;
}

/* One sample f at ray->q of a ray that passes close by a surface; ray->front: the lowest one so far. Samples on both
   sides, in strides that double (downhill the one behind is known: it was where the last began), until both are higher,
   and then in narrower ones around where the parabola through the three is lowest, until it is known how low that is.
   ray->side: 0 the first of two, 1 the second, 2 where the parabola is lowest, 3 the only one, before ray->b.
   Returns 0: it is more than `least`, or the ray's own hit; below 0: the crossing is bracketed. 1: another query; -1:
   undecided. */
static int disti_warm_pass(const disti_warm *warm, disti_ray *ray, float f, float least)
{
    ray->steps++;
    if (f <= 0.0f) { /* back to a positive sample and into the bracket */
        ray->b.s = ray->q;
        ray->b.f = f;
        ray->width = DISTI_MAX(1.5f * -f / warm->tracer->lipschitz, 0.25f * ray->width);
        return disti_ray_ask(ray, DISTI_BACK, DISTI_MAX(ray->q - ray->width, ray->enter));
    }
    if (ray->side == 0 || ray->side == 3) { /* the other side */
        int known = ray->side == 3;
        ray->side = 1;
        ray->a.f = f;
        if (!known) return disti_ray_ask(ray, DISTI_WAIT, DISTI_MIN(ray->front.s + ray->width, ray->leave));
        f = ray->b.f;
    }
    if (ray->side == 1 && ray->a.f >= ray->front.f && f >= ray->front.f) {
        float curvature = ray->a.f - 2.0f * ray->front.f + f, rise = DISTI_MAX(ray->a.f, f) - ray->front.f;
        float drop = curvature > 0.0f ? (ray->a.f - f) * (ray->a.f - f) / (8.0f * curvature) : 0.0f;
        float q = ray->front.s + disti_parabola(ray->width, ray->a.f, ray->front.f, f);
        q = DISTI_MIN(DISTI_MAX(q, ray->enter), ray->leave);
        /* above its chords, too */
        int convex = ray->front.f - rise > DISTI_MAX(0.5f * ray->front.f, 2.0f * warm->tracer->noise);
        if (convex || ray->front.f - drop - 0.25f * rise > DISTI_MAX(least, ray->moved ? 0.0f : 0.5f * ray->front.f)) {
            ray->front.s = q;
            ray->front.f -= drop;
            return 0;
        }
        ray->side = 2;
        return disti_ray_ask(ray, DISTI_WAIT, q);
    }
    if (ray->side == 2) {
        if (f < ray->front.f) ray->front.s = ray->q;
        ray->front.f = DISTI_MIN(ray->front.f, f);
        ray->width *= 0.25f;
        if (ray->width < 0.25f * least) return ray->front.f > least ? 0 : -1;
        ray->side = 0;
    } else {
        int back = ray->a.f < f;
        ray->front.s += back ? -ray->width : ray->width;
        ray->front.f = back ? ray->a.f : f;
        ray->b.f = f;
        ray->width *= 2.0f;
        ray->side = back ? 3 : 1;
    }
    if (ray->steps > 24 || ray->front.s <= ray->enter || ray->front.s >= ray->leave) return -1;
    if (ray->side == 1) {
        if (disti_warm_own(ray)) return 0;
        return disti_ray_ask(ray, DISTI_WAIT, DISTI_MIN(ray->front.s + ray->width, ray->leave));
    }
    return disti_ray_ask(ray, DISTI_WAIT, DISTI_MAX(ray->front.s - ray->width, ray->enter));
}

/* Ray i passes close by a surface or runs into it: from ray->front on, first to where spheres of as much room on both
   sides touch that of f. With ray->moved it has another end already, which stands if it passes. */
static int disti_warm_approach(disti_warm *warm, int i)
{
    disti_ray *ray = &warm->bench->rays[i];
    warm->ask[i] = DISTI_ASK_NEAR;
    ray->width = DISTI_MAX(2.0f * ray->front.f, 2e-3f * warm->tracer->field->radius);
    ray->side = 0;
    ray->steps = 0;
    ray->q = ray->front.s;
    return ray->front.f <= 0.0f ? disti_warm_pass(warm, ray, ray->front.f, 0.0f)
                          : disti_ray_ask(ray, DISTI_WAIT, DISTI_MAX(ray->front.s - ray->width, ray->enter));
}

/* Whether the tape's miss of ray i still stands if f was positive where it is least: no cone says otherwise. */
static int disti_warm_misses_still(const disti_warm *warm, int i)
{
    size_t pixel = disti_warm_pixel(warm, i);
    const disti_ray *ray = &warm->bench->rays[i];
    if (warm->tape->status[pixel] != ((int)DIST_RAY_MISS | DISTI_TAPE_SAMPLE)) return 0;
    if (!warm->open[i] || ray->mode == DISTI_DONE)
        return !warm->open[i] && ray->status == DIST_RAY_MISS && ray->enter < ray->leave;
    /* the cones went through here: nothing is known of a ray that they do not clear any more */
    if (!(warm->tape->value[pixel] > 0.0f) && warm->tape->start[pixel] <= ray->enter) return 0;
    return !(ray->guard > 2e38f) && disti_warm_reaches(warm, i) && !disti_warm_due(warm, i, DISTI_WARM_MISSES);
}

/* Change of the least f of miss i between nodes h pixels apart, as far as all four are known and changed alike: to
   within a quarter of what changes at all or .003 of f itself. 3e38: not known. */
static float disti_warm_drift(const disti_warm *warm, int i, int h, float f)
{
    int width = warm->tile->width, height = warm->tile->height, x = disti_warm_x(warm, i), y = disti_warm_y(warm, i);
    int x0 = x / h * h, x1 = DISTI_MIN(x0 + h, width - 1), y0 = y / h * h, y1 = DISTI_MIN(y0 + h, height - 1);
    float u = (float)(x - x0) / (float)DISTI_MAX(x1 - x0, 1), v = (float)(y - y0) / (float)DISTI_MAX(y1 - y0, 1);
    float a = warm->drift[y0 * width + x0], b = warm->drift[y0 * width + x1], c = warm->drift[y1 * width + x0],
          d = warm->drift[y1 * width + x1];
    float low = DISTI_MIN(DISTI_MIN(a, b), DISTI_MIN(c, d)), high = DISTI_MAX(DISTI_MAX(a, b), DISTI_MAX(c, d));
    if (high > 2e38f || high - low > DISTI_MAX(0.25f * warm->change, 2e-2f * f)) return 3e38f;
    return (1.0f - v) * ((1.0f - u) * a + u * b) + v * ((1.0f - u) * c + u * d);
}

/* With a silhouette: how the least |f| of each miss has changed. f is asked for where it was least, at every 8th pixel,
   where f is below .05 radii at every 4th, below .02 at a quarter of them in turn; between these (h = 8, 4, 2, 1) the
   change is interpolated. To first order f changes there as its least does (envelope theorem). */
static void disti_warm_drifts(disti_warm *warm, int h)
{
    const dist_field *field = warm->tracer->field;
    int width = warm->tile->width, height = warm->tile->height, every = h > 2 ? h : 1;
    float clamp = 1.5f * (field->clamp > 0.0f ? field->clamp : 0.1f * field->radius), far = 0.05f * field->radius;
    if (!warm->silhouette || warm->due) return;
    for (int y = 0; y < height; y = disti_node_after(y, every, height)) {
        for (int x = 0; x < width; x = disti_node_after(x, every, width)) {
            int i = y * width + x;
            if (warm->drift[i] < 2e38f || (h == 2 && !disti_warm_asks(warm, x, y))) continue;
            size_t pixel = disti_warm_pixel(warm, i);
            float f = warm->tape->value[pixel], drift = 3e38f, spread = 3e38f;
            if ((h == 2 && f > far) || !disti_warm_misses_still(warm, i)) continue;
            if (h == 8 && f > clamp && ((unsigned)((x ^ y) / 8) + warm->tape->turn) % 4u != 0) drift = 0.0f;
            if (h < 8 && f > far) drift = disti_warm_drift(warm, i, 8, f);
            if (h < 4 && f > 0.4f * far && drift > 2e38f) drift = disti_warm_drift(warm, i, 4, f);
            if (h == 1 && drift > 2e38f) drift = disti_warm_between(warm, warm->drift, 0, i, &spread);
            if (spread < 2e38f && !(spread < DISTI_MAX(0.25f * warm->change, 3e-3f * f))) drift = 3e38f;
            warm->drift[i] = drift;
            if (drift > 2e38f) disti_warm_list(warm, i, DISTI_ASK_DRIFT, warm->tape->s[pixel]);
        }
    }
}

/* How much f may have fallen this turn at s of ray i: by what it did at the hits around that lie about as far away, and
   a quarter more; without any, by the most that it changed in the tile. */
static float disti_warm_loss(const disti_warm *warm, int i, float s)
{
    int width = warm->tile->width, x = disti_warm_x(warm, i), y = disti_warm_y(warm, i), known = 0;
    float away = 0.05f * warm->tracer->field->radius, low = 0.0f;
    for (int v = DISTI_MAX(y - 2, 0); v <= DISTI_MIN(y + 2, warm->tile->height - 1); v++) {
        for (int u = DISTI_MAX(x - 2, 0); u <= DISTI_MIN(x + 2, width - 1); u++) {
            int k = v * width + u;
            float off = warm->bench->rays[k].best - s;
            if (warm->moved[k] > 2e38f || off > away || off < -away) continue;
            low = DISTI_MIN(low, -warm->moved[k] * warm->tape->value[disti_warm_pixel(warm, k)]);
            known++;
        }
    }
    return known > 1 ? DISTI_MIN(-1.25f * low + 0.1f * warm->change, warm->change) : warm->change;
}

/* The misses. Without a silhouette |f| is known not to be below tape->value less what has changed since; with one it is
   known by disti_warm_drifts. Where it may be near 0 it is asked for, and looked at on both sides: without a silhouette
   first at a quarter of them in turn (pass 0), then at those around which f has changed. */
static void disti_warm_misses(disti_warm *warm, int pass)
{
    for (int i = 0; i < warm->n; i++) {
        if (!warm->silhouette && disti_warm_asks(warm, disti_warm_x(warm, i), disti_warm_y(warm, i)) == pass) continue;
        size_t pixel = disti_warm_pixel(warm, i);
        disti_ray *ray = &warm->bench->rays[i];
        int blocked = ray->mode != DISTI_DONE, inside = warm->tape->status[pixel] & 15;
        float f = warm->tape->value[pixel], sunk = f + warm->change; /* at the entry: below 0, it still starts inside */
        if (inside == DIST_RAY_INSIDE && !warm->silhouette && blocked && !(ray->start > ray->enter) &&
            sunk < -warm->tracer->noise) {
            disti_ray_end(ray, DIST_RAY_INSIDE, ray->enter, sunk, 0.0f);
            ray->kept = 1;
            continue;
        }
        int told = warm->silhouette && !warm->due; /* by disti_warm_drifts */
        if (told ? warm->drift[i] > 2e38f : !(blocked || !warm->due) || !disti_warm_misses_still(warm, i)) continue;
        float epsilon = disti_ray_epsilon(warm->tracer, ray, ray->start);
        float unsure = warm->silhouette ? 1.5f * warm->change : disti_warm_loss(warm, i, warm->tape->s[pixel]);
        float lower = told ? f + warm->drift[i] : f - unsure;
        ray->best = warm->tape->s[pixel];
        ray->moved = 0;
        int near = blocked && (warm->due || lower < unsure + 3.0f * epsilon);
        float spread = 3e38f, drift = 3e38f;
        if (near && pass && !warm->silhouette) drift = disti_warm_between(warm, warm->drift, 0, i, &spread);
        if (spread < 0.1f * f && drift < 0.1f * f && drift > -0.1f * f) { /* has not changed around, either */
            lower = f + drift;
            near = 0;
        }
        if (near) {
            disti_warm_list(warm, i, DISTI_ASK_LEAST, ray->best);
        } else {
            disti_ray_end(ray, DIST_RAY_MISS, ray->best, DISTI_MAX(lower, 0.0f), 0.0f);
            ray->kept = 1;
        }
    }
}

/* Whether f is known to be large enough where a nearer surface beside ray i is, or there is none. fresh: for the first
   time this turn. */
static int disti_warm_clear(disti_warm *warm, int i, int fresh)
{
    float s = warm->tape->nearest[disti_warm_pixel(warm, i)], *bound = &warm->tape->beside[disti_warm_pixel(warm, i)];
    if (s > 2e38f) return 1;
    float loss = disti_warm_loss(warm, i, s);
    if (fresh) *bound = DISTI_MAX(*bound - loss, 0.0f);
    return *bound > 0.5f * loss + disti_ray_epsilon(warm->tracer, &warm->bench->rays[i], s);
}

/* What lies beside another surface, hits that have a nearer one beside them and misses, may be covered by that: spheres
   from its distance on until f rises again or is what the hit alone makes it; what they get close to is looked at.
   1: ray i is to be asked, misses every second turn, and hits, too, where calm > 1. */
static int disti_warm_beside(disti_warm *warm, int i, int fresh)
{
    disti_ray *ray = &warm->bench->rays[i];
    float s = warm->tape->nearest[disti_warm_pixel(warm, i)];
    warm->ask[i] = DISTI_ASK_NOTHING;
    if (disti_warm_clear(warm, i, fresh)) return 0;
    int hit = warm->moved[i] < 2e38f && s < ray->best, miss = ray->status == DIST_RAY_MISS && ray->kept;
    int turn = (disti_warm_x(warm, i) + disti_warm_y(warm, i) + (int)(warm->tape->turn & 1u)) & 1;
    if (!(hit || miss) || !(turn || (hit && warm->calm == 1))) return 0;
    if (!warm->open[i] || ray->mode != DISTI_DONE || (hit && s <= ray->start) || s >= ray->leave) return 0;
    ray->q = DISTI_MAX(s, ray->start);
    ray->front.f = 3e38f;
    ray->moved = 1;
    ray->steps = 0;
    warm->ask[i] = DISTI_ASK_BESIDE;
    return 1;
}

/* One sample f of a miss where it was least. */
static int disti_warm_least(disti_warm *warm, int i, float f)
{
    disti_ray *ray = &warm->bench->rays[i];
    float epsilon = disti_ray_epsilon(warm->tracer, ray, ray->best), radius = warm->tracer->field->radius;
    float margin = 5.0f * (warm->change + epsilon), value = warm->tape->value[disti_warm_pixel(warm, i)];
    int x = disti_warm_x(warm, i), y = disti_warm_y(warm, i), turn = (int)(warm->tape->turn & 7u);
    int first = disti_warm_asks(warm, x, y) && (x / 2 + y / 2 + turn / 4) & 1, odd = (i + y + turn) & 1;
    int same = f > 0.9f * value && f < 1.1f * value && !first; /* as where a plateau all but reaches 0 */
    int still = !warm->silhouette && warm->change < 1e-3f * radius && value > 0.0f &&
                (same || (odd && f > 3.0f * epsilon));
    if (!warm->silhouette && value > 0.0f) warm->drift[i] = f - value;
    if (!(warm->silhouette && value > 0.0f)) margin += 0.03f * radius; /* the bound is used up: a new one */
    ray->front.f = f;
    ray->front.s = ray->best;
    if (!(f > margin) && !still) return disti_warm_approach(warm, i);
    disti_ray_end(ray, DIST_RAY_MISS, ray->best, warm->silhouette || !(f > margin) ? f : 0.5f * f, 0.0f);
    ray->kept = !(f > margin && warm->due);
    return disti_warm_beside(warm, i, 0);
}

/* One of the spheres beside a nearer surface. */
static int disti_warm_sphere(disti_warm *warm, int i, float f)
{
    disti_ray *ray = &warm->bench->rays[i];
    int hit = ray->status == DIST_RAY_HIT, more;
    float epsilon = disti_ray_epsilon(warm->tracer, ray, ray->q), before = ray->front.f;
    float *bound = &warm->tape->beside[disti_warm_pixel(warm, i)];
    float away = hit ? 0.5f * warm->change + 2.0f * epsilon : 0.03f * warm->tracer->field->radius;
    ray->front.f = f;
    ray->front.s = ray->q;
    if (!(f > away) || ray->steps++ > 7) {
        *bound = DISTI_MAX(0.5f * f, 0.0f); /* if it meets no other */
        return disti_warm_approach(warm, i);
    }
    more = hit && f < before && f < -0.7f * ray->slope * (ray->best - ray->q);
    if (!more) *bound = 0.5f * DISTI_MIN(f, before); /* of this one and before */
    ray->q += f / warm->tracer->lipschitz;
    return more;
}

/* A sample of a ray that passes close by a surface. */
static int disti_warm_near(disti_warm *warm, int i, float f)
{
    disti_ray *ray = &warm->bench->rays[i];
    float least = 2.0f * disti_ray_epsilon(warm->tracer, ray, ray->front.s) + 0.1f * warm->change;
    float *bound = &warm->tape->beside[disti_warm_pixel(warm, i)];
    int more = ray->mode == DISTI_WAIT ? disti_warm_pass(warm, ray, f, least) : disti_ray_advance(warm->tracer, ray, f);
    if (more > 0) return 1;
    if (more < 0 || ray->mode != DISTI_WAIT) *bound = 0.0f;
    if (more < 0) return disti_warm_again(warm, i);
    ray->kept = 1;
    if (ray->mode != DISTI_WAIT) {
        warm->tape->owed[disti_warm_pixel(warm, i)] = 0.0f;
        warm->moved[i] = 3e38f;
        warm->bench->depth[i] = disti_hit_depth(ray);
    } else if (ray->moved) {
        float off = ray->front.s - ray->best, other = 0.01f * warm->tracer->field->radius;
        int same = ray->status == DIST_RAY_MISS && off < ray->width && -off < ray->width;
        ray->mode = DISTI_DONE; /* a miss that came down to its least, which has a bound of its own, met no other */
        if (!disti_warm_own(ray)) *bound = same ? DISTI_MAX(ray->front.f, other) : ray->front.f;
    } else {
        disti_ray_end(ray, DIST_RAY_MISS, ray->front.s, ray->front.f, 0.0f);
        return disti_warm_beside(warm, i, 0);
    }
    return 0;
}

/* Whether a hit that is marched anew has met nothing nearer (disti_warm_doubt) on its way to where it is expected, and
   f is what that alone makes it: then it is verified as the others are. */
static int disti_warm_arrives(const disti_warm *warm, int i)
{
    size_t pixel = disti_warm_pixel(warm, i);
    const disti_ray *ray = &warm->bench->rays[i];
    float left = warm->tape->s[pixel] - ray->front.s, slope = warm->tape->value[pixel];
    if (warm->ask[i] != DISTI_ASK_REFRESH || warm->moved[i] < 2e38f) return 0;
    if ((warm->tape->status[pixel] & 15) != DIST_RAY_HIT || !disti_warm_falls(warm, pixel)) return 0;
    if (ray->mode != DISTI_MARCH && ray->mode != DISTI_JUMP) return 0;
    return left > 0.0f && left < disti_warm_far(warm) && ray->front.f + warm->change >= -0.7f * slope * left;
}

static void disti_warm_drifted(disti_warm *warm, int i, float f)
{
    float value = warm->tape->value[disti_warm_pixel(warm, i)];
    if (!disti_finite(f)) return;
    warm->drift[i] = f - value;
    if (value > f && value < 0.02f * warm->tracer->field->radius) disti_warm_change(warm, value - f);
}

/* One sample f of ray i. 1: another query. */
static int disti_warm_take(disti_warm *warm, int i, float f)
{
    const disti_bench *bench = warm->bench;
    disti_ray *ray = &bench->rays[i];
    int ask = warm->ask[i];
    if (ask == DISTI_ASK_DRIFT) {
        disti_warm_drifted(warm, i, f);
        return 0;
    }
    if (ask < DISTI_ASK_MARCH && !disti_finite(f)) return disti_warm_again(warm, i);
    if (ask == DISTI_ASK_NEWTON) return disti_warm_newton(warm, i, f);
    if (ask == DISTI_ASK_LEAST) return disti_warm_least(warm, i, f);
    if (ask == DISTI_ASK_BESIDE) return disti_warm_sphere(warm, i, f);
    if (ask == DISTI_ASK_NEAR) return disti_warm_near(warm, i, f);
    disti_stats_slope(warm->tracer, ray, f, bench->stats);
    if (disti_ray_advance(warm->tracer, ray, f)) {
        if (!disti_warm_arrives(warm, i)) return 1;
        ray->slope = warm->tape->value[disti_warm_pixel(warm, i)];
        ray->q = warm->tape->s[disti_warm_pixel(warm, i)];
        ray->steps = 0;
        warm->ask[i] = DISTI_ASK_NEWTON;
        return 1;
    }
    bench->depth[i] = disti_hit_depth(ray);
    return 0;
}

/* What the hits so far, most of them without a query, owe of the budget. */
static void disti_warm_owe(const disti_warm *warm)
{
    const disti_bench *bench = warm->bench;
    if (!bench->budget) return;
    bench->budget->hits = 0;
    for (int i = 0; i < warm->n; i++)
        bench->budget->hits += (unsigned)disti_ray_is_hit(warm->tracer, &bench->rays[i]);
}

/* Whether the next two samples of ray i, on both sides of the lowest one, are asked for at once. */
static int disti_warm_both(const disti_warm *warm, int i)
{
    const disti_ray *ray = &warm->bench->rays[i];
    return warm->ask[i] == DISTI_ASK_NEAR && ray->mode == DISTI_WAIT && ray->side == 0;
}

/* Asks all listed rays at once, whatever for, until none is awaited, or all are done. */
static void disti_warm_rounds(disti_warm *warm, int all)
{
    const disti_bench *bench = warm->bench;
    while (all ? warm->count > 0 : warm->awaited > 0) {
        size_t count = warm->count, points = 0, at = 0;
        disti_warm_owe(warm);
        int pairs = 2 * count <= (size_t)DISTI_TILE_RAYS, each;
        for (size_t k = 0; k < count; k++) {
            const disti_ray *ray = &bench->rays[bench->index[k]];
            disti_ray_point(ray, ray->q, bench->points + 3 * points++);
            if (pairs && disti_warm_both(warm, bench->index[k]))
                disti_ray_point(ray, DISTI_MIN(ray->front.s + ray->width, ray->leave), bench->points + 3 * points++);
        }
        size_t asked = disti_query(warm->tracer, warm->worker, bench, points);
        for (size_t k = 0; k < count; k++) {
            int i = bench->index[k], ask = warm->ask[i], both = pairs && disti_warm_both(warm, i);
            int least = ask == DISTI_ASK_DRIFT || (ask == DISTI_ASK_LEAST && warm->silhouette);
            int march = ask >= DISTI_ASK_MARCH && bench->rays[i].mode < DISTI_BAND;
            each = at >= asked ? 0 : 1 + (both && at + 1 < asked);
            *(least   ? &bench->stats->silhouette_queries
              : march ? &bench->stats->march_queries
                      : &bench->stats->refine_queries) += (unsigned)each;
            float value = warm->tape->value[disti_warm_pixel(warm, i)]; /* 0: not measured */
            if (ask == DISTI_ASK_LEAST && each > 0 && value > bench->sdf[at])
                disti_warm_change(warm, value - bench->sdf[at]);
            at += (size_t)(1 + both);
        }
        at = warm->count = warm->awaited = 0;
        for (size_t k = 0; k < count; k++) {
            int i = bench->index[k], both = pairs && disti_warm_both(warm, i), more = 0;
            const float *f = bench->sdf + at;
            at += (size_t)(1 + both);
            if (at <= asked) more = disti_warm_take(warm, i, f[0]);
            else if (warm->ask[i] != DISTI_ASK_DRIFT) disti_warm_again(warm, i);
            if (more && both && warm->ask[i] == DISTI_ASK_NEAR && bench->rays[i].mode == DISTI_WAIT)
                more = disti_warm_take(warm, i, f[1]);
            if (!more) continue;
            bench->index[warm->count++] = i;
            warm->awaited += warm->ask[i] <= DISTI_ASK_LEAST;
        }
    }
}

/* Ray i marches, and is expected to end at s. */
static void disti_warm_refresh(disti_warm *warm, int i, float s)
{
    disti_warm_again(warm, i);
    disti_warm_list(warm, i, DISTI_ASK_REFRESH, warm->bench->rays[i].start);
    if (s < 2e38f) warm->moved[i] = s;
}

/* Lists what is around each ray that was marched anew and ended nearer than expected. */
static void disti_warm_doubt(disti_warm *warm)
{
    const disti_bench *bench = warm->bench;
    float far = disti_warm_far(warm);
    int width = warm->tile->width;
    for (int at = 0; at < warm->n; at++) {
        const disti_ray *ray = &bench->rays[at];
        if (warm->ask[at] != DISTI_ASK_REFRESH || ray->mode != DISTI_DONE) continue;
        size_t pixel = disti_warm_pixel(warm, at);
        int hit = (warm->tape->status[pixel] & 15) == DIST_RAY_HIT;
        float expected = warm->moved[at] < 2e38f ? warm->moved[at] : hit ? warm->tape->s[pixel] : ray->leave;
        warm->ask[at] = DISTI_ASK_KNOWN;
        if (ray->status != DIST_RAY_HIT || !(ray->best < expected - far)) continue;
        for (int k = 0; k < 9; k++) {
            int x = disti_warm_x(warm, at) + k % 3 - 1, y = disti_warm_y(warm, at) + k / 3 - 1, i = y * width + x;
            if (x < 0 || y < 0 || x >= width || y >= warm->tile->height || !bench->rays[i].kept) continue;
            const disti_ray *beside = &bench->rays[i];
            disti_warm_refresh(warm, i, beside->status == DIST_RAY_HIT ? beside->best : beside->leave);
        }
    }
}

/* Whether ray i is on the list, for other than what disti_render_warm still lists. */
static int disti_warm_listed(const disti_warm *warm, int i)
{
    return warm->ask[i] >= DISTI_ASK_LEAST && warm->ask[i] != DISTI_ASK_MARCH;
}

static void disti_render_warm(const disti_render_job *job, int worker, const disti_tile *tile, const disti_bench *bench)
{
    disti_warm warm;
    memset(&warm, 0, sizeof warm);
    warm.tape = job->tape;
    warm.tracer = job->tracer;
    warm.tile = tile;
    warm.bench = bench;
    warm.worker = worker;
    warm.n = tile->width * tile->height;
    warm.silhouette = job->least;
    warm.change = job->change;
    warm.calm = disti_warm_calm(job->change, job->tracer->field->radius);
    warm.due = warm.silhouette && disti_warm_minima_due(&warm);
    warm.moved = (float *)(void *)bench->rest;
    warm.drift = warm.moved + warm.n;
    warm.open = bench->rest + (size_t)warm.n * 2 * sizeof(float);
    warm.ask = warm.open + warm.n;
    warm.row = warm.ask + warm.n;
    size_t before, left = 0;
    for (int i = 0; i < warm.n; i++) {
        warm.moved[i] = warm.drift[i] = 3e38f;
        warm.row[i] = (unsigned char)(i / tile->width);
        warm.open[i] = bench->rays[i].mode != DISTI_DONE;
        warm.ask[i] = DISTI_ASK_NOTHING;
        bench->depth[i] = 0.0f;
    }
    for (int i = 0; i < warm.n; i++) { /* those whose turn it is march beside all that follows */
        size_t pixel = disti_warm_pixel(&warm, i);
        int miss = (warm.tape->status[pixel] & 15) == DIST_RAY_MISS;
        if (!warm.open[i] || !disti_warm_due(&warm, i, miss ? DISTI_WARM_MISSES : DISTI_WARM_HITS)) continue;
        if (miss || disti_warm_expects(&warm, i, warm.tape->s[pixel])) disti_warm_refresh(&warm, i, 3e38f);
    }
    before = warm.count;
    disti_warm_hits(&warm, 0);
    size_t tried = warm.count - before;
    disti_warm_drifts(&warm, 8);
    disti_warm_rounds(&warm, 0);
    int good = disti_warm_good(&warm, tried);
    for (int h = 4, pass = 1; h >= 1 && good; h /= 2, pass++) {
        if (pass < 3) disti_warm_hits(&warm, pass);
        disti_warm_drifts(&warm, h);
        disti_warm_rounds(&warm, 0);
    }
    for (int pass = warm.silhouette; pass < 2 && good; pass++) {
        disti_warm_misses(&warm, pass);
        if (!pass) disti_warm_rounds(&warm, 0);
    }
    for (int i = 0; i < warm.n && good; i++) {
        if (disti_warm_listed(&warm, i)) { /* its turn comes with its end, if any */
            disti_warm_clear(&warm, i, 1);
            continue;
        }
        if (disti_warm_beside(&warm, i, 1)) disti_warm_list(&warm, i, DISTI_ASK_BESIDE, bench->rays[i].q);
        left += bench->rays[i].mode != DISTI_DONE;
    }
    warm.late = good && left * 32 < (size_t)warm.n;
    for (int i = 0; i < warm.n; i++) {
        if (good ? disti_warm_listed(&warm, i) || bench->rays[i].mode == DISTI_DONE : !warm.open[i]) continue;
        if (disti_warm_again(&warm, i)) disti_warm_list(&warm, i, DISTI_ASK_MARCH, bench->rays[i].q);
    }
    do {
        if (good) disti_warm_rounds(&warm, 1);
        warm.late = 0;
        warm.count = 0;
        if (good) disti_warm_doubt(&warm);
    } while (warm.count > 0);
    disti_warm_owe(&warm);
}

/* Misses that were traced have no sample where |f| is least, and those that other rays' spheres cover none at all:
   these get their neighbor's place, and f = 0 says that the least is to be looked for next time. */
static void disti_warm_seed(const disti_tile *tile, const disti_bench *bench)
{
    int n = tile->width * tile->height;
    for (int pass = 0; pass < 2; pass++) {
        for (int k = 0; k < n; k++) {
            int i = pass ? n - 1 - k : k, x = i % tile->width, y = i / tile->width, side = pass ? 1 : -1;
            disti_ray *ray = &bench->rays[i];
            if (ray->status != DIST_RAY_MISS || ray->fbest < 2e38f || !(ray->enter < ray->leave)) continue;
            for (int axis = 0; axis < 2; axis++) {
                if (axis ? y + side < 0 || y + side >= tile->height : x + side < 0 || x + side >= tile->width) continue;
                const disti_ray *other = ray + (axis ? side * tile->width : side);
                if (other->fbest > 2e38f || other->status > DIST_RAY_HIT) continue;
                float s = (float)(other->base + (double)other->best - ray->base);
                ray->best = DISTI_MIN(DISTI_MAX(s, ray->enter), ray->leave);
                ray->fbest = 0.0f;
            }
        }
    }
    for (int i = 0; i < n; i++)
        if (bench->rays[i].status == DIST_RAY_MISS && bench->rays[i].fbest < 2e38f && !bench->rays[i].kept)
            bench->rays[i].fbest = 0.0f;
}

/* What disti_warm_beside asks: for each hit the s of the nearest hit among its eight neighbors, if that is more than
   three pixels nearer and the neighbor across is not as much farther; for each miss that of the hit farthest from its
   own place, if that is more than three pixels; 3e38: none. */
static void disti_nearest_task(void *arg, int index, int worker)
{
    const disti_render_job *job = (const disti_render_job *)arg;
    dist_tape *tape = job->tape;
    const int dx[4] = {1, 0, 1, 1}, dy[4] = {0, 1, 1, -1};
    (void)worker;
    int last = DISTI_MIN((index + 1) * DISTI_TILE, tape->height);
    for (int y = index * DISTI_TILE; y < last; y++) {
        for (int x = 0; x < tape->width; x++) {
            size_t pixel = (size_t)y * (size_t)tape->width + (size_t)x;
            float s = tape->s[pixel], nearest = 3e38f;
            int hit = tape->status[pixel] & DISTI_TAPE_HIT,
                none = tape->status[pixel] != ((int)DIST_RAY_MISS | DISTI_TAPE_SAMPLE);
            float most = job->step;
            for (int k = 0; k < 8 && (hit || !none); k++) {
                int side = k & 1 ? -1 : 1, ox = dx[k / 2] * side, oy = dy[k / 2] * side;
                if (x + ox < 0 || x + ox >= tape->width || y + oy < 0 || y + oy >= tape->height) continue;
                size_t other = (size_t)(y + oy) * (size_t)tape->width + (size_t)(x + ox);
                float ahead = s - tape->s[other];
                if (!(tape->status[other] & DISTI_TAPE_HIT)) continue;
                if (!hit) {
                    float off = ahead < 0.0f ? -ahead : ahead;
                    if (off > most) nearest = tape->s[other];
                    most = DISTI_MAX(most, off);
                    continue;
                }
                if (ahead < job->step) continue;
                int inside = x >= ox && x - ox < tape->width && y >= oy && y - oy < tape->height;
                size_t across = inside ? (size_t)(y - oy) * (size_t)tape->width + (size_t)(x - ox) : pixel;
                int steep = across != pixel && tape->status[across] & DISTI_TAPE_HIT &&
                    tape->s[across] - s > 0.3f * ahead;
                if (!steep) nearest = DISTI_MIN(nearest, tape->s[other]);
            }
            float before = tape->nearest[pixel], bound = tape->beside[pixel]; /* still of the same place? */
            if (bound > 0.0f && nearest < before + job->step && nearest > before - bound / job->tracer->lipschitz)
                continue;
            tape->nearest[pixel] = nearest;
            tape->beside[pixel] = 0.0f;
        }
    }
}

/* Whether the tape's picture can be started from: the same view of the same field, traced the same way, and with cones,
   which tell where nothing was. */
static int disti_render_warms(const disti_tracer *tracer, const dist_camera *camera, const dist_tape *tape)
{
    const dist_field *a = tracer->field, *b = &tape->field;
    const dist_render_desc *how = &tape->tracer.how;
    return tape->rendered && memcmp(camera, &tape->camera, sizeof *camera) == 0 && a->eval_fn == b->eval_fn &&
           a->user == b->user && memcmp(a->center, b->center, sizeof a->center) == 0 && a->radius >= b->radius &&
           a->radius <= b->radius && tracer->epsilon >= tape->tracer.epsilon &&
           tracer->epsilon <= tape->tracer.epsilon && how->inside == tracer->how.inside && tape->tiled > 0 &&
           !how->no_cones && !tracer->how.no_cones && !tracer->how.certified;
}

static void disti_tile_init(const disti_render_job *job, int index, disti_tile *tile)
{
    memset(tile, 0, sizeof *tile);
    tile->view = job->view;
    tile->normals = job->out->normal && job->tracer->how.normal_mode == DIST_NORMAL_ANALYTIC;
    tile->x = index % job->across * job->tile;
    tile->y = index / job->across * job->tile;
    tile->own_width = tile->width = DISTI_MIN(job->tile, job->view->width - tile->x);
    tile->own_height = tile->height = DISTI_MIN(job->tile, job->view->height - tile->y);
    tile->lattice = job->lattice ? job->lattice : (int)DISTI_LATTICE; /* a warm start predicts all the same */
    tile->lazy = job->lazy;
    tile->cheap = job->cheap;
}

/* A warm picture's cones: few a tile, so those of several tiles are asked for together. */
enum { DISTI_CONE_TILES = 9 };

static void disti_cones_task(void *arg, int index, int worker)
{
    const disti_render_job *job = (const disti_render_job *)arg;
    disti_bench bench;
    disti_tile tiles[DISTI_CONE_TILES];
    size_t active = 0, each = (size_t)disti_tile_cones(job->tile);
    int first = index * (int)DISTI_CONE_TILES, count = DISTI_MIN(job->count - first, (int)DISTI_CONE_TILES);
    int leaf = job->least ? (int)DISTI_LATTICE : 2 * (int)DISTI_LATTICE; /* the silhouette is made from theirs, too */
    memset(tiles, 0, sizeof tiles);
    disti_bench_init(job->tracer->ctx, worker, &bench);
    disti_cone *cones = (disti_cone *)(void *)bench.rest, *to[DISTI_CONE_TILES];
    for (int i = 0; i < count; i++) {
        int before = bench.cones;
        disti_tile_init(job, first + i, &tiles[i]);
        disti_cones_first(job->tracer, &tiles[i], &bench, (int)DISTI_CONE_WARM, leaf, &active);
        for (int k = before; k < bench.cones; k++) cones[k].tile = i;
        to[i] = job->tape->cones + (size_t)(first + i) * each;
    }
    disti_cone_rounds(job->tracer, worker, tiles, &bench, active, leaf);
    for (int k = 0; k < bench.cones; k++)
        if (cones[k].state != DISTI_CONE_SPLIT) *to[cones[k].tile]++ = cones[k];
    for (int i = 0; i < count; i++) to[i]->size = 0;
}

enum { DISTI_RANKS = 64 };

/* 0: about the most, DISTI_RANKS - 1: next to nothing. */
static int disti_cost_rank(unsigned cost, unsigned most)
{
    return DISTI_RANKS - 1 - (int)((DISTI_RANKS - 1) * (double)cost / most);
}

/* Lists the tiles of a picture like the last one by what they cost then, the most costly first, to a 64th of that: the
   workers are all done at about the same time. */
static void disti_render_order(disti_render_job *job)
{
    const dist_tape *tape = job->tape;
    int first[DISTI_RANKS + 1]; /* the place of each rank's first tile */
    unsigned most = 1;
    job->order = NULL;
    job->cost = tape && job->tracer->how.trace == DIST_TRACE_GUARDED ? tape->cost : NULL;
    if (!job->cost || !tape->rendered || tape->tiled != job->tile || job->tracer->ctx->workers == 1) return;
    for (int i = 0; i < job->count; i++) most = DISTI_MAX(most, tape->cost[i]);
    memset(first, 0, sizeof first);
    for (int i = 0; i < job->count; i++) first[1 + disti_cost_rank(tape->cost[i], most)]++;
    for (int k = 1; k <= DISTI_RANKS; k++) first[k] += first[k - 1];
    for (int i = 0; i < job->count; i++) tape->order[first[disti_cost_rank(tape->cost[i], most)]++] = i;
    job->order = tape->order;
}

/* The index-th tile from the middle of across * down tiles on, ring by ring: what costs most comes first, so that the
   workers are all done at about the same time. */
static int disti_tile_outward(int across, int down, int index)
{
    int x, y, w = across, h = down, left = across * down - 1 - index; /* counted from outside */
    for (; w > 2 && h > 2 && left >= 2 * (w + h - 2); w -= 2, h -= 2) left -= 2 * (w + h - 2);
    if (left < 2 * w) {
        x = left % w;
        y = left < w ? 0 : h - 1;
    } else {
        left -= 2 * w;
        x = left & 1 ? w - 1 : 0;
        y = 1 + left / DISTI_MIN(w, 2);
    }
    return (y + (down - h) / 2) * across + x + (across - w) / 2;
}

/* A tile's rays by the guarded tracer. 0: none goes anywhere, and the planes are written. */
static int disti_render_guarded(const disti_render_job *job, int worker, int index, disti_tile *tile,
                                disti_bench *bench, disti_budget *budget)
{
    const disti_tracer *tracer = job->tracer;
    int n = tile->width * tile->height, open = 1;
    unsigned long long kept = job->least ? budget->left / 4 : 0; /* for the smallest f of misses */
    budget->left -= kept;
    for (int i = 0; i < DISTI_LEASTS; i++) bench->least_of->f[i] = 3e38f, bench->least_of->out[i] = 0.0f;
    if (!tracer->how.no_cones)
        open = disti_cones(tracer, worker, tile, bench, job->lattice ? job->lattice : (int)DISTI_CONE_LEAF,
                           job->coned ? job->tape->cones + (size_t)index * (size_t)disti_tile_cones(job->tile) : NULL);
    if (tile->lazy && job->out->stats) disti_render_meets(job, tile, bench->stats);
    if (tile->lazy && !open) {
        disti_render_empty(job, tile, bench);
        return 0;
    }
    budget->marching = 1;
    for (int i = 0; i < n && job->tape; i++) {
        disti_ray *ray = &bench->rays[i];
        ray->stop = ray->mode == DISTI_DONE && ray->enter < ray->leave ? ray->leave : ray->start; /* cleared */
    }
    float steepest = bench->stats->steepest;
    bench->stats->steepest = 0.0f;
    if (job->warm) bench->cones = 0; /* its memory is put to another use */
    if (job->warm) disti_render_warm(job, worker, tile, bench);
    open |= job->warm;
    if (open && job->lattice) disti_trace_lattice(tracer, worker, tile, bench);
    else if (open) disti_trace_all(tracer, worker, bench, (size_t)n);
    int proven = tracer->how.certified && !(bench->stats->steepest > 0.0f);
    bench->stats->steepest = DISTI_MAX(bench->stats->steepest, steepest);
    if (open && (job->out->error || job->out->stats)) {
        if (!proven) disti_trace_doubt(tracer, tile, bench);
        if (disti_is_coarse(tracer->field)) disti_coarse_doubt(tracer, tile, bench);
    }
    budget->marching = 0;
    disti_tile_trim(job, tile, bench);
    disti_trace_end(tracer, bench, (size_t)(tile->width * tile->height));
    budget->left += kept;
    if (job->least) disti_silhouette(tracer, worker, tile, bench);
    else if (job->tape && job->tape->value) disti_warm_seed(tile, bench);
    return 1;
}

static void disti_render_task(void *arg, int index, int worker)
{
    const disti_render_job *job = (const disti_render_job *)arg;
    const disti_tracer *tracer = job->tracer;
    disti_bench bench;
    disti_tile tile;
    disti_bench_init(tracer->ctx, worker, &bench);
    unsigned long long before = bench.stats->queries;
    if (job->order) index = job->order[index];
    else if (tracer->ctx->workers > 1) index = disti_tile_outward(job->across, job->count / job->across, index);
    disti_tile_init(job, index, &tile);
    disti_budget budget;
    disti_render_budget(job, &tile, &budget);
    if (tracer->how.max_queries > 0) bench.budget = &budget;
    int predict = job->lattice && !job->warm;
    if (predict && tile.x + tile.width < job->view->width) tile.width++;
    if (predict && tile.y + tile.height < job->view->height) tile.height++;
    if (!tile.lazy) disti_tile_rays(tracer, &tile, &bench, 0, 0, tile.width, tile.height);
#ifndef DIST_NO_PAPER
    if (tracer->how.trace == DIST_TRACE_PAPER) {
        size_t first = (size_t)tile.y * (size_t)job->view->width + (size_t)tile.x;
        float *samples = job->tape ? job->tape->sample + first * (size_t)tracer->how.samples * 4 : NULL;
        disti_paper_trace(tracer, worker, &tile, &bench, samples, (size_t)job->view->width);
    } else
#endif
    if (!disti_render_guarded(job, worker, index, &tile, &bench, &budget)) return;
    unsigned long long met = bench.stats->rays_in_sphere;
    disti_render_planes(job, worker, &tile, &bench);
    if (tile.lazy) bench.stats->rays_in_sphere = met; /* planes counts only those that were made */
    if (job->cost) job->cost[index] = (unsigned)(bench.stats->queries - before);
}

/* Pixels that stand alone have no neighbors to share cones and predictions with: their rays, and no others, are packed
   together from all over the picture. 0: most stand close together (more than one in eight has its right neighbor
   asked for, too), or tiles are needed for the silhouette. The count of tasks follows from the picture alone. */
static int disti_render_list(const disti_tracer *tracer, const disti_view *view, disti_render_job *job)
{
    const unsigned char *pixels = tracer->how.pixels;
    size_t n = (size_t)view->width * (size_t)view->height, wanted = 0, pairs = 0;
    if (!pixels || job->least || tracer->how.trace != DIST_TRACE_GUARDED) return 0;
    for (size_t i = 0; i < n; i++) {
        wanted += pixels[i] != 0;
        pairs += pixels[i] && (i + 1) % (size_t)view->width != 0 && pixels[i + 1];
    }
    if (8 * pairs > wanted) return 0;
    size_t each = job->each = DISTI_MAX(wanted / DISTI_LIST_TASKS + 1, (size_t)DISTI_LIST_RAYS / 16);
    int count = 1;
    job->first[0] = 0;
    for (size_t i = 0, seen = 0; i < n; i++) {
        if (!pixels[i]) continue;
        if (seen == (size_t)count * each) job->first[count++] = i;
        seen++;
    }
    job->first[count] = n;
    return count;
}

static void disti_render_list_task(void *arg, int index, int worker)
{
    const disti_render_job *job = (const disti_render_job *)arg;
    const disti_tracer *tracer = job->tracer;
    disti_bench bench;
    disti_tile tile;
    disti_ray skipped;
    disti_budget budget;
    double done = (double)index * (double)job->each;
    disti_bench_init(tracer->ctx, worker, &bench);
    if (tracer->how.max_queries > 0) bench.budget = &budget;
    disti_ray_skip(&skipped);
    memset(&tile, 0, sizeof tile);
    size_t *list = (size_t *)(void *)(bench.rest + DISTI_REST_BYTES - DISTI_LIST_RAYS * sizeof(size_t));
    tile.view = job->view;
    tile.list = list;
    tile.height = tile.own_height = 1;
    for (size_t i = job->first[index]; i < job->first[index + 1];) {
        for (tile.width = 0; i < job->first[index + 1] && tile.width < DISTI_LIST_RAYS; i++) {
            disti_render_pixel(job, &skipped, i);
            if (!tracer->how.pixels[i]) continue;
            list[tile.width] = i;
            disti_pixel_ray(job->view, tracer->field, i, &bench.rays[tile.width++]);
        }
        disti_budget_init(job, done, (double)tile.width, (double)job->count * (double)job->each, &budget);
        budget.marching = 1;
        done += (double)tile.width;
        disti_trace_all(tracer, worker, &bench, (size_t)tile.width);
        disti_trace_end(tracer, &bench, (size_t)tile.width);
        tile.own_width = tile.width;
        disti_render_planes(job, worker, &tile, &bench);
    }
}

static double disti_view_away(const disti_view *view, const dist_field *field)
{
    double away[3];
    for (int i = 0; i < 3; i++) away[i] = view->center[i] - (double)field->center[i];
    return sqrt(disti_dot(away, away));
}

/* Neighbors say something about each other where pixels are below a 50th of the radius. The lattice is 8 of them wide,
   but no wider than .08 of the radius, so that large pixels lose no more of what is thin. */
static int disti_render_lattice(const disti_tracer *tracer, const disti_view *view)
{
    double f = DISTI_MIN(fabs(view->fx), fabs(view->fy));
    double pixel = disti_view_away(view, tracer->field) / f / (double)tracer->field->radius;
    if (tracer->how.trace != DIST_TRACE_GUARDED || tracer->how.no_cones || tracer->how.no_prediction) return 0;
    return pixel < 0.01 ? (int)DISTI_LATTICE : pixel < 0.02 ? (int)DISTI_LATTICE / 2 : 0;
}

/* Mean |f| at up to 1024 of the tape's hits, at most one in 16, evenly over the picture: how much has changed. 3e38: it
   has none. */
static float disti_render_change(disti_tracer *tracer, const disti_view *view, dist_tape *tape)
{
    enum { SIDE = 32 };
    int dx = DISTI_MAX((view->width + SIDE - 1) / SIDE, 4), dy = DISTI_MAX((view->height + SIDE - 1) / SIDE, 4);
    size_t count = 0;
    double sum = 0.0;
    disti_bench bench;
    for (int y = dy / 2; y < view->height; y += dy) {
        for (int x = dx / 2; x < view->width; x += dx) {
            size_t pixel = (size_t)y * (size_t)view->width + (size_t)x;
            disti_ray ray;
            if (!(tape->status[pixel] & DISTI_TAPE_HIT)) continue;
            disti_pixel_ray(view, tracer->field, pixel, &ray);
            disti_ray_point(&ray, tape->s[pixel], tape->points + 3 * count++);
        }
    }
    if (tracer->how.max_queries > 0) { /* out of the budget, or too much for it */
        if (tracer->how.max_queries < 4 * (unsigned long long)count) return 3e38f;
        tracer->how.max_queries -= count;
    }
    disti_field_eval_all(tracer->ctx, tracer->field, count, tape->points, tape->d_sdf, NULL);
    disti_bench_init(tracer->ctx, 0, &bench);
    bench.stats->queries += count;
    bench.stats->refine_queries += count;
    for (size_t i = 0; i < count; i++) sum += fabs((double)tape->d_sdf[i]);
    return count > 0 && disti_finite_double(sum) ? (float)(sum / (double)count) : 3e38f;
}

/* Whether out and tape go with the rest, which is checked. */
static dist_status disti_render_check(const disti_tracer *tracer, const dist_camera *camera, const dist_images *out,
                                      const dist_tape *tape, const char *name)
{
    dist_context *ctx = tracer->ctx;
    const dist_render_desc *how = &tracer->how;
    dist_status status = DIST_OK;
    if (!out) return disti_refuse(ctx, "%s: out is NULL", name);
    if (how->any_hit || how->max_distance > 0.0f)
        return disti_fail(ctx, DIST_BAD_ARGUMENT,
                          how->any_hit ? "%s: how.any_hit is %d, must be 0: it is for dist_trace"
                                       : "%s: how.max_distance is %d, must be 0: it is for dist_trace",
                          name, how->any_hit ? 1.0 : (double)how->max_distance, 0);
    if (out->color) status = disti_color_check(ctx, tracer->field, 0, name);
    if (status != DIST_OK) return status;
    if (tape && tape->ctx != ctx) return disti_refuse(ctx, "%s: tape belongs to another context", name);
    if (tape && (tape->width != camera->width || tape->height != camera->height))
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: tape is for another size than camera.width %d, height %d", name,
                          camera->width, camera->height);
    if (how->warm_start && (!tape || !tape->value))
        return disti_refuse(ctx, "dist_render: how.warm_start is 1, but tape is %s",
                            tape ? "not made with it" : "NULL");
    if (tape && (tape->trace != how->trace || (tape->sample && tape->samples != how->samples)))
        return disti_refuse(ctx, "%s: tape was created with another trace or another number of samples", name);
    return DIST_OK;
}

DIST_API dist_status dist_render(dist_context *ctx, const dist_field *field, const dist_camera *camera,
                                 const dist_render_desc *desc, const dist_images *out, dist_tape *tape)
{
    const char *name = "dist_render";
    disti_tracer tracer;
    disti_view view;
    disti_render_job job;
    dist_status status = disti_enter(ctx, name);
    if (status == DIST_OK) status = disti_field_check(ctx, field, name);
    if (status == DIST_OK) status = disti_camera_check(ctx, camera, name);
    if (status == DIST_OK) status = disti_tracer_init(&tracer, ctx, field, desc, name);
    if (status == DIST_OK) status = disti_render_check(&tracer, camera, out, tape, name);
    if (status != DIST_OK) return status;
    disti_view_of(camera, &view);
    disti_stats_begin(ctx);
    job.tracer = &tracer;
    job.view = &view;
    job.out = out;
    job.tape = tape;
    job.lattice = disti_render_lattice(&tracer, &view);
    job.least = out->silhouette || (tape && tracer.how.relax_band > 0.0f);
    job.lazy = !job.least && !tape && !tracer.how.pixels && !tracer.how.no_cones &&
               tracer.how.trace == DIST_TRACE_GUARDED;
    job.cheap = job.lazy && field->cost > 0.0f && field->cost < 5000.0f;
    job.tile = tracer.how.trace == DIST_TRACE_PAPER ? DISTI_TILE_USUAL / 2 : disti_tile_least(view.width, view.height);
    int large = (double)view.width * (double)view.height >= 512.0 * 512.0; /* enough of them all the same */
    if (job.tile == DISTI_TILE_USUAL && (field->many || job.cheap || large)) job.tile = DISTI_TILE;
    job.across = (view.width + job.tile - 1) / job.tile;
    int listed = disti_render_list(&tracer, &view, &job);
    job.count = listed ? listed : job.across * ((view.height + job.tile - 1) / job.tile);
    disti_sphere_box(&view, field, job.box);
    job.warm = tape && tracer.how.warm_start && !listed && disti_render_warms(&tracer, camera, tape);
    job.step = (float)(6.0 * disti_view_footprint(&view, 1.0) * disti_view_away(&view, field));
    job.change = job.warm ? disti_render_change(&tracer, &view, tape) : 0.0f;
    if (!(job.change <= 4e-3f * field->radius)) job.warm = 0;
    if (job.warm) disti_run(ctx, (view.height + DISTI_TILE - 1) / DISTI_TILE, disti_nearest_task, &job);
    job.coned = job.warm && job.lattice == DISTI_LATTICE && !tracer.how.pixels && tracer.how.max_queries == 0;
    if (job.coned) disti_run(ctx, (job.count + DISTI_CONE_TILES - 1) / DISTI_CONE_TILES, disti_cones_task, &job);
    if (!listed) disti_render_order(&job);
    disti_run(ctx, job.count, listed ? disti_render_list_task : disti_render_task, &job);
    disti_stats_end(ctx, &tracer, out->stats);
    disti_stats_steepest(ctx, &tracer, out->stats);
    if (!tape) return DIST_OK;
    tape->rendered = 1;
    tape->tiled = listed ? 0 : job.tile;
    tape->has_silhouette = job.least;
    tape->field = *field;
    tape->changes = disti_changes(field);
    tape->color_changes = disti_color_changes(field);
    tape->camera = *camera;
    tape->tracer = tracer;
    tape->tracer.field = &tape->field;
    tape->tracer.how.pixels = NULL;
    tape->turn = job.warm ? tape->turn + 1 : 0;
    return DIST_OK;
}

#ifndef DIST_NO_BACKWARD
/* Backward of a picture, in terms of y = dL/dp, the pull on a point that moves with the field held still:

   depth = distance * z of the unit ray in camera space, so d_t = d_depth z + d_distance.
   implicit   f(c + t v) = 0 gives dt = -(df + grad f . (dc + t dv)) / (grad f . v): the seed
              a = -d_t / (grad f . v) on df, and y = a grad f. |grad f . v| counts as at least tau |grad f|, its sign
              kept; such rays are counted.
   normal     the same with d_t weighted by |n . v|, so that grazing pixels do not dominate.
   paper      t = sum of alpha f(p_k) over the K samples of smallest |f|, points held constant, nothing where
              |f| > 0.1: the seed alpha d_t at each p_k. The residual e of eq. (4) is dropped, and K samples are
              summed, not averaged: the paper's approximation, in the scale of its authors' code.      (paper, 3.4)
   silhouette S = f(p_min) - epsilon: the seed d_S at the sample of smallest |f|                    (envelope theorem)
              Where that is an end of the ray's part of the bounding sphere, with normal n there, the end slides along
              the ray as the camera moves: of dp the sphere leaves dp - v (n . dp) / (n . v), so for the camera
              y = d_S (g - n (g . v) / (n . v)); |n . v| counts as at least tau.
              no hit, yet f(p_min) < 0, as where the ray starts in the solid: S = -f(p_min) - epsilon, so the seed -d_S.
              off the sphere S = |o| - radius with o the ray's point nearest to it: y = d_S o / |o|.
   normal's   n = G / |G|: u = (d_n - n (n . d_n)) / |G| pulls on G, and s = u . G with u held has the rest: the field
              receives ds of it, the hit y = H u and, but in the paper's mode, d_t += y . v. Exact where f is smooth
              and the field says how; by differences along u where it has kinks, which is the only derivative that a
              ReLU net's normal has; in the difference mode by those of the normal itself.
   color      c = g(p, z, color code) at the hit p = o + t v: y = (dg/dp)^T d_c, d_t += y . v; z, the color code and the
              color's weights receive dg's own part.
   outline    color is c_in where m = min over t of f(o + t v) is below 0 and c_out where it is above, so that its sum
              over the picture changes by the integral of delta(m) (c_out - c_in) dm, of which single rays see nothing.
              delta(m) is relaxed to 1 / band on 0 < m < band: the seed d_c . (c_out - c_in) / band at the sample of
              smallest f of rays that miss by less. c_in: of the surface next to it, by one step of Newton; d_c:
              interpolated where that point is seen, since the outline has pixels on both sides; c_out: background.
              (Wang, Deng, Zhang, Jakob, Marschner, "A Simple Approach to Differentiable Rendering of SDFs", 2024, whose
              band this is, with one ray a pixel; theirs also sees one surface before another.)

   All of them end as seeds a on df and pulls y, which disti_add_pull brings to the camera; and a normal in camera space
   turns with it: d_rotation += n x d_n.                                                                       */
typedef struct disti_render_backward_job {
    const dist_tape *tape;
    const dist_images *d_out;
    const dist_gradients *grads;
    dist_context *ctx;
    disti_view view;
    double rotation[3], translation[3], focal[2], principal[2];
    double *total, *d_code; /* of both codes, and of the first where it is wanted */
    unsigned long long capped, points, skipped;
    size_t count;
    disti_pieces pieces; /* of a run's hits with d_normal */
    int camera, geometry; /* a gradient of the camera, one that depends on where the hit is at all, is wanted */
} disti_render_backward_job;

/* Seeds once grad f is known: d_sdf = entry's own, and the implicit rule's, or the paper's where all K samples are the
   hit: there a ray that leaves the solid stops farther away as f falls. */
static void disti_render_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                              float *d_sdf)
{
    const dist_tape *tape = ((const disti_render_backward_job *)user)->tape;
    int mode = tape->tracer.how.gradient;
    (void)sdf;
    for (size_t i = 0; i < count; i++) {
        disti_entry *entry = &tape->entry[first + i];
        const float *g = gradient + 3 * i, *v = entry->direction;
        float length = disti_length(g[0], g[1], g[2]);
        entry->capped = !disti_finite(length); /* nothing comes of a point whose gradient overflows */
        d_sdf[i] = entry->capped ? 0.0f : entry->d_sdf;
        entry->weight = 1.0f;
        if (entry->d_distance == 0.0f && entry->d_motion == 0.0f && !entry->capped) continue;
        if (mode == DIST_GRADIENT_PAPER && !entry->capped) { /* no way out but where it was asked for */
            const dist_render_desc *how = &tape->tracer.how;
            int out = how->inside == DIST_INSIDE_EXIT && g[0] * v[0] + g[1] * v[1] + g[2] * v[2] > 0.0f;
            d_sdf[i] += (out ? -1.0f : 1.0f) * how->step_scale * (float)how->samples * entry->d_distance;
            continue;
        }
        if (entry->capped || !(length > 1e-30f)) {
            entry->capped = 1;
            entry->weight = 0.0f;
            continue;
        }
        float along = (g[0] * v[0] + g[1] * v[1] + g[2] * v[2]) / length; /* n . v, in [-1, 1] */
        float magnitude = along < 0.0f ? -along : along;
        float least = tape->tracer.how.gradient_cap;
        entry->capped = magnitude < least;
        if (mode == DIST_GRADIENT_NORMAL) entry->weight = magnitude;
        float bounded = DISTI_MAX(magnitude, least);
        /* at along = 0 the sign is that of a ray that enters */
        float d_t = entry->d_distance * entry->weight + entry->d_motion;
        d_sdf[i] += (along > 0.0f ? -1.0f : 1.0f) * d_t / (bounded * length);
        if (disti_finite(d_sdf[i])) continue;
        d_sdf[i] = entry->weight = 0.0f;
        entry->capped = 1;
    }
}

/* The one place where a pixel's share reaches the camera. p: a point on a ray, where it is for this camera; y = dL/dp
   as the camera moves and p keeps its distance t along its ray; d_z: dL/d(z of p in camera space) from elsewhere (depth
   is t times the unit ray's z), which then only the ray's own tilt changes. In camera space, with Y = R y:

   pose        p = R^T (q - translation), q = t l held still: d_rotation -= R p x Y, d_translation -= Y.
   intrinsics  q = t l, l = n / |n|, n = (a, b, 1), b = (v - cy) / fy, a = (u - cx - skew b) / fx, so that
               dq = Z (I - l l^T) dn with Z = t l_z, and e = (I - l l^T) (Y + d_z e_z) pulls on n with weight Z:
               da = -(a dfx + dcx + skew db) / fx, db = -(b dfy + dcy) / fy; Z a and Z b are q's x and y. */
static void disti_add_pull(disti_render_backward_job *job, const double p[3], const double y[3], double d_z)
{
    const disti_view *view = &job->view;
    double q[3], pull[3], torque[3], e[2];
    if (!job->camera) return;
    disti_rotate(view->rotation, p, q);
    disti_rotate(view->rotation, y, pull);
    disti_cross(q, pull, torque);
    for (int i = 0; i < 3; i++) {
        job->rotation[i] -= torque[i];
        job->translation[i] -= pull[i];
        q[i] += view->translation[i];
    }
    pull[2] += d_z;
    double square = disti_dot(q, q), along = square > 0.0 ? disti_dot(q, pull) / square : 0.0;
    e[0] = (pull[0] - q[0] * along) / view->fx;
    e[1] = (pull[1] - q[1] * along - view->skew * e[0]) / view->fy;
    for (int i = 0; i < 2; i++) {
        job->focal[i] -= e[i] * q[i];
        job->principal[i] -= e[i] * q[2];
    }
}

/* disti_add_pull of dL/dpoint at p, of which nothing counts that is not finite; returns dL/dt of p = o + t v. */
static float disti_backward_hit(disti_render_backward_job *job, const float *p, const float *d_point, const float v[3],
                                float d_z)
{
    double point[3], y[3], d_distance = 0.0;
    if (!disti_finite_all(3, d_point)) return 0.0f;
    for (int i = 0; i < 3; i++) {
        point[i] = (double)p[i];
        y[i] = (double)d_point[i];
        d_distance += y[i] * (double)v[i];
    }
    disti_add_pull(job, point, y, (double)d_z);
    return (float)d_distance;
}

/* Pieces that the entries are cut into before each is put in order by itself. */
enum { DISTI_PIECE = 4 * (int)DISTI_GROUP_POINTS };

static void disti_backward_sort_task(void *arg, int index, int worker)
{
    const disti_render_backward_job *job = (const disti_render_backward_job *)arg;
    const dist_tape *tape = job->tape;
    disti_place *place = (disti_place *)(void *)disti_chunk_scratch(job->ctx);
    const disti_entry *entry = (const disti_entry *)(const void *)(place + DISTI_CHUNK);
    int begin = index * DISTI_PIECE, end = DISTI_MIN(begin + DISTI_PIECE, (int)job->count);
    (void)worker;
    disti_sort_places(place, begin, end, DISTI_CELL_POINTS);
    for (int i = begin; i < end; i++) {
        memcpy(tape->points + 3 * i, place[i].p, 3 * sizeof(float));
        tape->entry[i] = entry[place[i].at];
    }
}

/* Puts the entries in such order that the blocks of a field that likes many points hold neighbors. */
static void disti_backward_sort(disti_render_backward_job *job)
{
    disti_place *place = (disti_place *)(void *)disti_chunk_scratch(job->ctx);
    int count = (int)job->count;
    disti_places_init(place, job->tape->points, count);
    memcpy(place + DISTI_CHUNK, job->tape->entry, job->count * sizeof(disti_entry));
    disti_sort_places(place, 0, count, DISTI_PIECE);
    disti_run(job->ctx, (count + DISTI_PIECE - 1) / DISTI_PIECE, disti_backward_sort_task, job);
}

/* dL/dpoint of a point that stays on the bounding sphere. */
static void disti_backward_edge(const dist_tape *tape, const float *p, const float v[3], float *d_point)
{
    double n[3], along = 0.0, across = 0.0;
    for (int i = 0; i < 3; i++) n[i] = (double)p[i] - (double)tape->field.center[i];
    if (!disti_normalize(n) || !disti_finite_all(3, d_point)) return;
    for (int i = 0; i < 3; i++) {
        along += (double)d_point[i] * (double)v[i];
        across += n[i] * (double)v[i];
    }
    double least = (double)tape->tracer.how.gradient_cap;
    if (fabs(across) < least) across = across < 0.0 ? -least : least;
    for (int i = 0; i < 3; i++) d_point[i] = disti_within_float((double)d_point[i] - n[i] * along / across);
}

/* Runs the adjoint over the entries gathered so far. */
static void disti_backward_flush(disti_render_backward_job *job)
{
    const dist_tape *tape = job->tape;
    const dist_field *field = &tape->field;
    if (job->count == 0) return;
    if (field->many || (field->kinks && field->cost > 1e5f)) disti_backward_sort(job);
    memset(tape->d_points, 0, 3 * job->count * sizeof(float));
    disti_field_backward_all(job->ctx, field, job->count, tape->points, tape->d_sdf, disti_render_seed, job,
                             tape->d_points, job->d_code);
    if (job->grads->weights)
        field->weights_fn(field->user, job->ctx, job->count, tape->points, tape->d_sdf, NULL, NULL, NULL, NULL,
                          job->grads->weights);
    for (size_t i = 0; i < job->count; i++) {
        const disti_entry *entry = &tape->entry[i];
        job->capped += entry->capped;
        if (entry->edge) disti_backward_edge(tape, tape->points + 3 * i, entry->direction, tape->d_points + 3 * i);
        if (job->camera)
            disti_backward_hit(job, tape->points + 3 * i, tape->d_points + 3 * i, entry->direction,
                               entry->weight * entry->d_depth);
    }
    job->points += job->count;
    job->count = 0;
}

static void disti_backward_add(disti_render_backward_job *job, const disti_ray *ray, const float *point,
                               float d_distance, float d_motion, float d_depth, float d_sdf, int edge)
{
    const dist_tape *tape = job->tape;
    disti_entry *entry = &tape->entry[job->count];
    entry->d_distance = d_distance;
    entry->d_motion = d_motion;
    entry->d_depth = d_depth;
    entry->d_sdf = d_sdf;
    entry->edge = (unsigned char)edge;
    memcpy(entry->direction, ray->direction, sizeof entry->direction);
    memcpy(tape->points + 3 * job->count, point, 3 * sizeof(float));
    if (++job->count == DISTI_CHUNK) disti_backward_flush(job);
}

/* The ray of a pixel, and the point p of it that the tape keeps. */
static void disti_tape_ray(const disti_render_backward_job *job, size_t pixel, disti_ray *ray, float *p)
{
    disti_pixel_ray(&job->view, &job->tape->field, pixel, ray);
    disti_ray_point(ray, job->tape->s[pixel], p);
}

/* One pixel with an upstream gradient; d_point and d_bend: dL/dpoint at its hit by its color and normal, or NULL. */
static void disti_backward_pixel(disti_render_backward_job *job, size_t pixel, float d_depth, float d_distance,
                                 float d_silhouette, const float *d_point, const float *d_bend)
{
    const dist_tape *tape = job->tape;
    const dist_field *field = &tape->field;
    const disti_tracer *tracer = &tape->tracer;
    unsigned char status = tape->status[pixel];
    disti_ray ray;
    double nearest[3], pull[3];
    float p[3], none[3] = {0.0f, 0.0f, 0.0f};
    int paper = tracer->how.gradient == DIST_GRADIENT_PAPER;
    if (!job->camera && !(status & (DISTI_TAPE_HIT | DISTI_TAPE_SAMPLE))) return; /* off the sphere, most often */
    disti_tape_ray(job, pixel, &ray, p);
    if (ray.enter >= ray.leave) { /* off the sphere: only the camera feels it */
        disti_ray_nearest(field, &ray, nearest, pull);
        disti_normalize(pull);
        for (int i = 0; i < 3; i++) pull[i] *= (double)d_silhouette;
        disti_add_pull(job, nearest, pull, 0.0);
        return;
    }
    if (!(status & DISTI_TAPE_SAMPLE)) d_silhouette = 0.0f;
    if (status & DISTI_TAPE_SOLID) d_silhouette = -d_silhouette;
    d_distance += d_depth * ray.cosine;
    if (paper) { /* the tilt's share, which in the other modes goes with the hit's entry */
        disti_backward_hit(job, p, none, ray.direction, d_depth);
        d_depth = 0.0f;
    }
    float d_motion = d_point ? disti_backward_hit(job, p, d_point, ray.direction, 0.0f) : 0.0f;
    if (paper) d_distance += d_motion, d_motion = 0.0f;
    float bends = d_bend ? disti_backward_hit(job, p, d_bend, ray.direction, 0.0f) : 0.0f;
    if (!paper) d_motion += bends;
    if (tape->sample) {
        const float *samples = tape->sample + pixel * (size_t)tape->samples * 4;
        for (int k = 0; k < (paper ? tape->samples : 1); k++) {
            float f = samples[4 * k], seed = k == 0 ? d_silhouette : 0.0f;
            int inside_clamp = (f < 0.0f ? -f : f) <= 0.1f * field->radius;
            if (paper && inside_clamp) seed += disti_paper_alpha(&tracer->how) * d_distance;
            if (seed != 0.0f) disti_backward_add(job, &ray, samples + 4 * k + 1, 0.0f, 0.0f, 0.0f, seed, 0);
        }
        if (!paper && (d_distance != 0.0f || d_motion != 0.0f))
            disti_backward_add(job, &ray, p, d_distance, d_motion, d_depth, 0.0f, 0);
        return;
    }
    float s = tape->s[pixel], near = 2e-6f * field->radius; /* how exactly ends are known */
    int edge = s >= ray.leave - near || (s <= ray.enter + near && ray.enter > (float)-ray.base + near);
    edge &= !(status & DISTI_TAPE_HIT);
    if (d_distance != 0.0f || d_motion != 0.0f || d_silhouette != 0.0f)
        disti_backward_add(job, &ray, p, d_distance, d_motion, d_depth, d_silhouette, edge);
}

/* Upstream gradients that are not finite count as 0. */
static float disti_upstream(const float *plane, size_t at)
{
    return plane && disti_finite(plane[at]) ? plane[at] : 0.0f;
}

/* dL/dcolor or dL/dnormal of a pixel, from its plane; 0: it has none. */
static int disti_upstream_three(const disti_render_backward_job *job, const float *plane, size_t pixel, float d[3])
{
    if (!plane || !(job->tape->status[pixel] & DISTI_TAPE_HIT)) return 0;
    for (size_t k = 0; k < 3; k++) d[k] = disti_upstream(plane, 3 * pixel + k);
    return d[0] != 0.0f || d[1] != 0.0f || d[2] != 0.0f;
}

/* Those of `count` pixels, at most DISTI_RUN, that have an upstream gradient in the plane: their hits in tape->hit, the
   gradients in d; returns how many. */
static size_t disti_backward_hits(const disti_render_backward_job *job, const float *plane, size_t first, size_t count,
                                  float *d)
{
    const dist_tape *tape = job->tape;
    size_t n = 0;
    for (size_t pixel = first; pixel < first + count; pixel++) {
        disti_ray ray;
        if (!disti_upstream_three(job, plane, pixel, d + 3 * n)) continue;
        disti_tape_ray(job, pixel, &ray, tape->hit + 3 * n++);
    }
    return n;
}

/* grad f at the hits, to tape->d_points, which is free until the entries are flushed. */
static void disti_normals_task(void *arg, int index, int worker)
{
    const disti_render_backward_job *job = (const disti_render_backward_job *)arg;
    const dist_tape *tape = job->tape;
    disti_bench bench;
    size_t first, n = disti_piece(&job->pieces, index, &first);
    disti_bench_init(job->ctx, worker, &bench);
    disti_normal_gradient(&tape->tracer, worker, &bench, n, tape->hit + 3 * first, tape->d_points + 3 * first);
}

/* The normals of `count` pixels, at most DISTI_RUN, back to code and weights, to the camera that turns with them, and
   H u to tape->bend for the hits of those that have an upstream gradient, one after another. */
static void disti_backward_normals(disti_render_backward_job *job, size_t first, size_t count)
{
    const dist_tape *tape = job->tape;
    const dist_field *field = &tape->field;
    const dist_render_desc *how = &tape->tracer.how;
    size_t n = disti_backward_hits(job, job->d_out->normal, first, count, tape->bend), stencil = 2;
    if (n == 0) return;
    if (how->normal_mode == DIST_NORMAL_DIFFERENCE) stencil = 6;
    else if (field->second_fn && !field->kinks && (!job->grads->weights || field->second_weights_fn)) stencil = 0;
    job->pieces = disti_cut(n, 4 * DISTI_BLOCK, 1u << 20);
    disti_run(job->ctx, job->pieces.count, disti_normals_task, job);
    for (size_t i = 0; i < n; i++) {
        float *gradient = tape->d_points + 3 * i;
        double g[3], normal[3], d[3], seen[3], torque[3];
        for (size_t k = 0; k < 3; k++) {
            g[k] = normal[k] = (double)gradient[k];
            d[k] = (double)tape->bend[3 * i + k];
            gradient[k] = 0.0f;
        }
        if (!disti_normalize(normal)) continue;
        if (how->normal_space == DIST_SPACE_CAMERA) {
            disti_rotate(job->view.rotation, normal, seen);
            disti_cross(seen, d, torque);
            for (int k = 0; k < 3; k++) job->rotation[k] += torque[k];
            disti_rotate_back(job->view.rotation, d, seen);
            memcpy(d, seen, sizeof d);
        }
        double along = disti_dot(normal, d), length = sqrt(disti_dot(g, g));
        for (int k = 0; k < 3; k++) gradient[k] = (float)((d[k] - normal[k] * along) / length);
        if (!disti_finite_all(3, gradient)) gradient[0] = gradient[1] = gradient[2] = 0.0f;
    }
    memset(tape->bend, 0, 3 * n * sizeof(float));
    disti_field_second(job->ctx, field, n, tape->hit, tape->d_points, stencil, how->normal_delta, tape->bend,
                       job->d_code, job->grads->weights);
    job->points += n * (stencil ? stencil : 1);
}

/* The colors of `count` pixels, at most DISTI_RUN, back to codes and weights, and to tape->pull for the hits of those
   that have an upstream gradient, one after another. */
static void disti_backward_colors(disti_render_backward_job *job, size_t first, size_t count)
{
    const dist_tape *tape = job->tape;
    const dist_field *field = &tape->field;
    size_t n = disti_backward_hits(job, job->d_out->color, first, count, tape->d_color);
    memset(tape->pull, 0, 3 * n * sizeof(float));
    disti_color_backward_all(job->ctx, field, n, tape->hit, tape->d_color, job->geometry ? tape->pull : NULL,
                             job->grads, job->total);
    job->points += n;
}

/* dL/dcolor between pixels, bilinear, at the place where point p is seen. */
static void disti_upstream_between(const disti_render_backward_job *job, const float p[3], float d_color[3])
{
    const disti_view *view = &job->view;
    double world[3], q[3], at[2], size[2] = {view->width - 1.0, view->height - 1.0};
    int low[2];
    for (int i = 0; i < 3; i++) world[i] = (double)p[i];
    disti_rotate(view->rotation, world, q);
    for (int i = 0; i < 3; i++) q[i] += view->translation[i];
    memset(d_color, 0, 3 * sizeof(float));
    if (!(q[2] > 0.0)) return;
    at[0] = (view->fx * q[0] + view->skew * q[1]) / q[2] + view->cx - view->first;
    at[1] = view->fy * q[1] / q[2] + view->cy - view->first;
    for (int i = 0; i < 2; i++) {
        at[i] = DISTI_MIN(DISTI_MAX(at[i], 0.0), size[i]);
        low[i] = (int)at[i];
        at[i] -= low[i];
    }
    for (int corner = 0; corner < 4; corner++) {
        int right = corner & 1, below = corner >> 1;
        double share = (right ? at[0] : 1.0 - at[0]) * (below ? at[1] : 1.0 - at[1]);
        if (!(share > 0.0)) continue; /* also what is beyond the edge */
        size_t pixel = (size_t)(low[1] + below) * (size_t)view->width + (size_t)(low[0] + right);
        for (size_t k = 0; k < 3; k++) d_color[k] += (float)share * disti_upstream(job->d_out->color, 3 * pixel + k);
    }
}

/* The outline's seeds of `count` pixels, at most DISTI_RUN. */
static void disti_backward_outline(disti_render_backward_job *job, size_t first, size_t count)
{
    const dist_tape *tape = job->tape;
    const dist_field *field = &tape->field;
    const dist_render_desc *how = &tape->tracer.how;
    float *p = tape->hit, *surface = tape->d_points, *color = tape->pull, *seed = tape->d_color, d_color[3];
    disti_ray ray;
    size_t n = 0;
    for (size_t pixel = first; pixel < first + count; pixel++) {
        if (!(tape->status[pixel] & DISTI_TAPE_NEAR)) continue;
        disti_tape_ray(job, pixel, &ray, p + 3 * n);
        if (tape->sample) memcpy(p + 3 * n, tape->sample + pixel * (size_t)tape->samples * 4 + 1, 3 * sizeof(float));
        n++;
    }
    if (n == 0) return;
    disti_field_eval_all(job->ctx, field, n, p, tape->d_sdf, surface);
    for (size_t i = 0; i < n; i++) {
        float *g = surface + 3 * i, square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2];
        float step = disti_finite(square) && square > 1e-20f ? tape->d_sdf[i] / square : 0.0f;
        for (size_t k = 0; k < 3; k++) g[k] = p[3 * i + k] - (step != 0.0f ? step * g[k] : 0.0f);
    }
    field->color_fn(field->user, 0, n, surface, color);
    for (size_t i = 0; i < n; i++) {
        float sum = 0.0f;
        disti_upstream_between(job, surface + 3 * i, d_color);
        for (size_t k = 0; k < 3; k++) sum += d_color[k] * (how->background_color[k] - color[3 * i + k]);
        seed[i] = disti_finite(sum) ? sum / how->relax_band : 0.0f;
    }
    memset(&ray, 0, sizeof ray); /* a seed asks for no direction */
    for (size_t i = 0; i < n; i++)
        if (seed[i] != 0.0f) disti_backward_add(job, &ray, p + 3 * i, 0.0f, 0.0f, 0.0f, seed[i], 0);
}

/* `count` pixels, at most DISTI_RUN. */
static void disti_backward_pixels(disti_render_backward_job *job, size_t first, size_t count)
{
    const dist_tape *tape = job->tape;
    const dist_images *d_out = job->d_out;
    const float *pull = tape->pull, *bend = tape->bend; /* of the next hit that has an upstream gradient */
    if (d_out->color && job->geometry && tape->tracer.how.relax_band > 0.0f) disti_backward_outline(job, first, count);
    if (d_out->color) disti_backward_colors(job, first, count);
    if (d_out->normal && job->geometry) disti_backward_normals(job, first, count);
    for (size_t pixel = first; pixel < first + count; pixel++) {
        int hit = tape->status[pixel] & DISTI_TAPE_HIT, asked = tape->status[pixel] != DIST_RAY_SKIPPED;
        float d_depth = hit ? disti_upstream(d_out->depth, pixel) : 0.0f;
        float d_distance = hit ? disti_upstream(d_out->distance, pixel) : 0.0f;
        float d_silhouette = asked ? disti_upstream(d_out->silhouette, pixel) : 0.0f;
        float d[3];
        int colored = disti_upstream_three(job, d_out->color, pixel, d);
        int normal = disti_upstream_three(job, d_out->normal, pixel, d);
        if (d_depth == 0.0f && d_distance == 0.0f && d_silhouette == 0.0f && !normal && !colored) {
            job->skipped++;
            continue;
        }
        if (job->geometry)
            disti_backward_pixel(job, pixel, d_depth, d_distance, d_silhouette, colored ? pull : NULL,
                                 normal ? bend : NULL);
        pull += colored ? 3 : 0;
        bend += normal ? 3 : 0;
    }
}

DIST_API dist_status dist_render_backward(dist_context *ctx, const dist_tape *tape, const dist_images *d_out,
                                          const dist_gradients *grads)
{
    const char *name = "dist_render_backward";
    disti_render_backward_job job;
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    if (!tape || !tape->rendered)
        return disti_refuse(ctx, "dist_render_backward: tape is %s; it must have been filled by dist_render",
                            tape ? "empty" : "NULL");
    if (tape->ctx != ctx) return disti_refuse(ctx, "%s: tape belongs to another context", name);
    if (!d_out) return disti_refuse(ctx, "%s: d_out is NULL", name);
    status = disti_gradients_check(ctx, &tape->field, grads, name);
    if (status != DIST_OK) return status;
    if (disti_changes(&tape->field) != tape->changes)
        return disti_refuse(ctx, "%s: the field's code, weights or instances are not what they were in dist_render; "
                                 "change them after the backward pass", name);
    if (d_out->silhouette && !tape->has_silhouette && tape->trace != DIST_TRACE_PAPER)
        return disti_refuse(ctx, "%s: d_out.silhouette is given, but out.silhouette was NULL in dist_render", name);
    if (d_out->color) status = disti_color_check(ctx, &tape->field, 1, name);
    if (status != DIST_OK) return status;
    if (d_out->color && disti_color_changes(&tape->field) != tape->color_changes)
        return disti_refuse(ctx, "%s: the color's code or weights are not what they were in dist_render; change them "
                                 "after the backward pass", name);
    memset(&job, 0, sizeof job);
    size_t size = (size_t)tape->field.code_size + (size_t)tape->field.color_code_size, room = ctx->partial_size - 1;
    if (!grads->code && !grads->color_code && !d_out->color) size = 0; /* no code's gradient is summed */
    if (size + size / DISTI_SLOTS > room) /* see disti_partial_for */
        return disti_fail(ctx, DIST_UNSUPPORTED, "%s: the field's codes have %d numbers, at most %d here; a "
                                                 "dist_field_backward for one point makes room for more", name,
                          (double)size, (double)(room - room / (DISTI_SLOTS + 1)));
    job.tape = tape;
    job.d_out = d_out;
    job.grads = grads;
    job.ctx = ctx;
    job.camera = disti_gradients_camera(grads);
    disti_view_of(&tape->camera, &job.view);
    job.geometry = grads->code || grads->weights || job.camera;
    job.total = ctx->partial + (size_t)DISTI_SLOTS * size;
    memset(job.total, 0, size * sizeof(double));
    if (grads->code) job.d_code = job.total;
    unsigned state = disti_float_state_enter(); /* also for what is not in disti_run */
    size_t pixels = (size_t)tape->width * (size_t)tape->height;
    if (!job.geometry && !grads->color_code && !grads->color_weights) pixels = 0; /* nothing is wanted */
    for (size_t first = 0; first < pixels; first += DISTI_RUN)
        disti_backward_pixels(&job, first, DISTI_MIN(pixels - first, (size_t)DISTI_RUN));
    disti_backward_flush(&job);
    disti_float_state_leave(state);
    disti_codes_add(&tape->field, grads, job.total);
    for (int i = 0; i < 3; i++) {
        if (grads->rotation) disti_add_within(&grads->rotation[i], job.rotation[i]);
        if (grads->translation) disti_add_within(&grads->translation[i], job.translation[i]);
        if (grads->focal && i < 2) disti_add_within(&grads->focal[i], job.focal[i]);
        if (grads->principal && i < 2) disti_add_within(&grads->principal[i], job.principal[i]);
    }
    if (d_out->stats) {
        d_out->stats->capped += job.capped;
        d_out->stats->backward_points += job.points;
        d_out->stats->skipped += job.skipped;
    }
    return DIST_OK;
}
#endif

/*@ 09 loss --------------------------------------------------------------------------------------------------------- */

/* A pixel counts where the mask has a hit (no mask: everywhere). What is not finite never counts: one bad pixel must
   not spoil the mean of the others. */
static int disti_loss_hit(const unsigned char *mask, size_t i)
{
    return mask == NULL || mask[i] != 0;
}

static double disti_sign(double x)
{
    return x > 0.0 ? 1.0 : (x < 0.0 ? -1.0 : 0.0);
}

/* One channel is a depth, three are a color. */
static int disti_loss_counts(size_t channels, const float *x, const float *target, const unsigned char *mask, size_t i)
{
    if (!disti_loss_hit(mask, i) || !disti_finite_all(channels, x + channels * i)) return 0;
    if (!disti_finite_all(channels, target + channels * i)) return 0;
    return channels > 1 || (target[i] > 0.0f && target[i] < 1e5f);
}

/* forward   L = weight / N sum_k |x_k - target_k|,  N: numbers of the pixels that count
   backward  d_x_k += weight / N sign(x_k - target_k); 0 at the kink */
static float disti_loss_absolute(size_t n, size_t channels, const float *x, const float *target,
                                 const unsigned char *mask, float weight, float *d_x)
{
    double sum = 0.0;
    size_t count = 0;
    if (!x || !target || !disti_finite(weight)) return 0.0f;
    for (size_t i = 0; i < n; i++) {
        if (!disti_loss_counts(channels, x, target, mask, i)) continue;
        for (size_t k = channels * i; k < channels * (i + 1); k++) sum += fabs((double)x[k] - (double)target[k]);
        count += channels;
    }
    if (count == 0) return 0.0f;
    double scale = (double)weight / (double)count;
    for (size_t i = 0; d_x && i < n; i++) {
        if (!disti_loss_counts(channels, x, target, mask, i)) continue;
        for (size_t k = channels * i; k < channels * (i + 1); k++)
            d_x[k] += (float)(scale * disti_sign((double)x[k] - (double)target[k]));
    }
    return disti_within_float(scale * sum);
}

DIST_API float dist_loss_depth(size_t n, const float *depth, const float *target, const unsigned char *mask,
                               float weight, float *d_depth)
{
    return disti_loss_absolute(n, 1, depth, target, mask, weight, d_depth);
}

DIST_API float dist_loss_color(size_t n, const float *color, const float *target, const unsigned char *mask,
                               float weight, float *d_color)
{
    return disti_loss_absolute(n, 3, color, target, mask, weight, d_color);
}

/* 1 / |target|, or 0 where the pixel does not count. */
static double disti_loss_normal_scale(const float *normal, const float *target, const unsigned char *mask, size_t i)
{
    const float *t = target + 3 * i;
    if (!disti_loss_hit(mask, i) || !disti_finite_all(3, t) || !disti_finite_all(3, normal + 3 * i)) return 0.0;
    double square = (double)t[0] * (double)t[0] + (double)t[1] * (double)t[1] + (double)t[2] * (double)t[2];
    return square > 0.0 ? 1.0 / sqrt(square) : 0.0;
}

/* forward   L = -weight / N sum_i normal_i . target_i / |target_i|
   backward  d_normal_i += -weight / N target_i / |target_i| */
DIST_API float dist_loss_normal(size_t n, const float *normal, const float *target, const unsigned char *mask,
                                float weight, float *d_normal)
{
    double sum = 0.0;
    size_t count = 0;
    if (!normal || !target || !disti_finite(weight)) return 0.0f;
    for (size_t i = 0; i < n; i++) {
        double inverse = disti_loss_normal_scale(normal, target, mask, i);
        if (!(inverse > 0.0)) continue;
        for (size_t k = 3 * i; k < 3 * i + 3; k++) sum -= (double)normal[k] * (double)target[k] * inverse;
        count++;
    }
    if (count == 0) return 0.0f;
    double scale = (double)weight / (double)count;
    for (size_t i = 0; d_normal && i < n; i++) {
        double inverse = disti_loss_normal_scale(normal, target, mask, i);
        if (!(inverse > 0.0)) continue;
        for (size_t k = 3 * i; k < 3 * i + 3; k++) d_normal[k] -= (float)(scale * (double)target[k] * inverse);
    }
    return disti_within_float(scale * sum);
}

/* forward   L = weight sum_k 1 / N_k sum_{i: S_gt = k} max(0, S_i) for k = 1, max(0, -S_i) for k = 0     (paper, eq. 8)
   backward  d_S_i += weight / N_1 where S_gt and S_i > 0, -= weight / N_0 where not S_gt and S_i < 0; 0 at the kink
   N_k: all finite pixels, or those of its sum that are not 0. */
static float disti_loss_silhouette(size_t n, const float *silhouette, const unsigned char *target, float weight,
                                   int wrong_only, float *d_silhouette)
{
    double sum[2] = {0.0, 0.0};
    double count[2] = {0.0, 0.0};
    double scale[2];
    if (!silhouette || !target || !disti_finite(weight)) return 0.0f;
    for (size_t i = 0; i < n; i++) {
        if (!disti_finite(silhouette[i])) continue;
        int in = target[i] != 0;
        double wrong = in ? (double)silhouette[i] : -(double)silhouette[i];
        if (wrong > 0.0) sum[in] += wrong;
        if (wrong > 0.0 || !wrong_only) count[in] += 1.0;
    }
    if (!wrong_only) count[0] = count[1] = count[0] + count[1];
    for (int k = 0; k < 2; k++) scale[k] = count[k] > 0.0 ? (double)weight / count[k] : 0.0;
    for (size_t i = 0; d_silhouette && i < n; i++) {
        if (!disti_finite(silhouette[i])) continue;
        if (target[i] && silhouette[i] > 0.0f) d_silhouette[i] += (float)scale[1];
        if (!target[i] && silhouette[i] < 0.0f) d_silhouette[i] -= (float)scale[0];
    }
    return disti_within_float(scale[0] * sum[0] + scale[1] * sum[1]);
}

DIST_API float dist_loss_silhouette(size_t n, const float *silhouette, const unsigned char *target, float weight,
                                    float *d_silhouette)
{
    return disti_loss_silhouette(n, silhouette, target, weight, 0, d_silhouette);
}

DIST_API float dist_loss_silhouette_wrong(size_t n, const float *silhouette, const unsigned char *target, float weight,
                                          float *d_silhouette)
{
    return disti_loss_silhouette(n, silhouette, target, weight, 1, d_silhouette);
}

/* forward   L = weight sum_j code_j^2
   backward  d_code_j += 2 weight code_j */
DIST_API float dist_loss_code(size_t n, const float *code, float weight, float *d_code)
{
    double sum = 0.0;
    if (!code || !disti_finite(weight)) return 0.0f;
    for (size_t j = 0; j < n; j++) {
        if (!disti_finite(code[j])) continue;
        sum += (double)code[j] * (double)code[j];
        if (d_code) disti_add_within(&d_code[j], 2.0 * (double)weight * (double)code[j]);
    }
    return disti_within_float((double)weight * sum);
}

/* Photometric loss. One pixel's way from view `to` into view `from`, with r its ray of depth 1:
       c = depth r,   q = M c + b = R_from R_to^T (c - t_to) + t_from,
       u = (fx q_x + skew q_y) / q_z + cx,   v = fy q_y / q_z + cy,   color = bilinear I_from(u, v) */
typedef struct disti_warp {
    double color[3], slope[3][2]; /* and its derivatives by u and v */
    double ray[3], q[3];
    int visible;
} disti_warp;

typedef struct disti_photo_pair {
    const dist_photo *to, *from;
    disti_view view_to, view_from;
    double turn[9], shift[3]; /* M, b */
    double visibility, ssim;
} disti_photo_pair;

/* Weights and pixels of the bilinear sample at (u, v); 0 outside the picture, by more than rounding. */
static int disti_bilinear(const disti_view *view, double u, double v, size_t pixel[4], double part[2])
{
    const double edge = 1e-9, most_u = view->width - 1.0, most_v = view->height - 1.0;
    if (!(u >= -edge && v >= -edge && u <= most_u + edge && v <= most_v + edge)) return 0;
    u = DISTI_MIN(DISTI_MAX(u, 0.0), most_u);
    v = DISTI_MIN(DISTI_MAX(v, 0.0), most_v);
    size_t w = (size_t)view->width, x = (size_t)u, y = (size_t)v;
    size_t right = x + 1 < w ? 1 : 0, below = y + 1 < (size_t)view->height ? w : 0;
    part[0] = u - (double)x;
    part[1] = v - (double)y;
    pixel[0] = y * w + x;
    pixel[1] = pixel[0] + right;
    pixel[2] = pixel[0] + below;
    pixel[3] = pixel[1] + below;
    return 1;
}

static int disti_photo_depth_counts(const dist_photo *photo, size_t i)
{
    return disti_loss_hit(photo->mask, i) && disti_finite(photo->depth[i]) && photo->depth[i] > 0.0f &&
           photo->depth[i] < 1e5f;
}

static void disti_warp_pixel(const disti_photo_pair *pair, int x, int y, disti_warp *warp)
{
    const disti_view *a = &pair->view_to, *b = &pair->view_from;
    const dist_photo *from = pair->from;
    size_t i = (size_t)y * (size_t)a->width + (size_t)x, pixel[4];
    double part[2], *q = warp->q;
    memset(warp, 0, sizeof *warp);
    if (!disti_photo_depth_counts(pair->to, i) || !disti_finite_all(3, pair->to->color + 3 * i)) return;
    warp->ray[1] = (y + a->first - a->cy) / a->fy;
    warp->ray[0] = (x + a->first - a->cx - a->skew * warp->ray[1]) / a->fx;
    warp->ray[2] = 1.0;
    disti_rotate(pair->turn, warp->ray, q);
    for (int k = 0; k < 3; k++) q[k] = q[k] * (double)pair->to->depth[i] + pair->shift[k];
    if (!(q[2] > 1e-9)) return;
    double u = (b->fx * q[0] + b->skew * q[1]) / q[2] + b->cx - b->first, v = b->fy * q[1] / q[2] + b->cy - b->first;
    if (!disti_bilinear(b, u, v, pixel, part)) return;
    double share[4] = {(1.0 - part[0]) * (1.0 - part[1]), part[0] * (1.0 - part[1]), (1.0 - part[0]) * part[1],
                       part[0] * part[1]};
    double depth = 0.0, sum = 0.0;
    for (int c = 0; c < 4; c++) {
        if (!disti_finite_all(3, from->color + 3 * pixel[c])) return;
        if (!from->depth || share[c] == 0.0 || !disti_photo_depth_counts(from, pixel[c])) continue;
        depth += share[c] * (double)from->depth[pixel[c]];
        sum += share[c];
    }
    if (from->depth && pair->visibility >= 0.0) { /* the mean of the corners that are hits: an outline is seen, too */
        double off = sum > 0.0 ? q[2] - depth / sum : 0.0;
        if (!(sum > 0.0) || !(off * off < pair->visibility)) return;
    }
    for (size_t k = 0; k < 3; k++) {
        double corner[4];
        for (int c = 0; c < 4; c++) corner[c] = (double)from->color[3 * pixel[c] + k];
        double top = corner[1] - corner[0], bottom = corner[3] - corner[2], left = corner[2] - corner[0];
        warp->slope[k][0] = top + part[1] * (bottom - top);
        warp->slope[k][1] = left + part[0] * (bottom - top);
        warp->color[k] = corner[0] + part[0] * warp->slope[k][0] + part[1] * left;
    }
    warp->visible = 1;
}

/* forward   SSIM = A B / (C D) of the warped x and the seen y, m, s their means and (co)variances over nine pixels:
             A = 2 m_x m_y + 1e-4, B = 2 s_xy + 9e-4, C = m_x^2 + m_y^2 + 1e-4, D = s_xx + s_yy + 9e-4
   backward  d_x_k += d_SSIM 2/9 (m_y B / (C D) + A (y_k - m_y) / (C D) - SSIM (m_x / C + (x_k - m_x) / D)) */
static double disti_ssim(const double x[9], const double y[9], double d_ssim, double d_x[9])
{
    double mx = 0.0, my = 0.0, sxx = 0.0, syy = 0.0, sxy = 0.0;
    for (int k = 0; k < 9; k++) mx += x[k] / 9.0, my += y[k] / 9.0;
    for (int k = 0; k < 9; k++) {
        sxx += (x[k] - mx) * (x[k] - mx) / 9.0;
        syy += (y[k] - my) * (y[k] - my) / 9.0;
        sxy += (x[k] - mx) * (y[k] - my) / 9.0;
    }
    double a = 2.0 * mx * my + 1e-4, b = 2.0 * sxy + 9e-4, c = mx * mx + my * my + 1e-4, d = sxx + syy + 9e-4;
    double ssim = a * b / (c * d);
    for (int k = 0; k < 9; k++)
        d_x[k] = d_ssim * 2.0 / 9.0 *
                 (my * b / (c * d) + a * (y[k] - my) / (c * d) - ssim * (mx / c + (x[k] - mx) / d));
    return ssim;
}

/* A square of pixels with the two rings around it that its 3 x 3 windows reach into. */
enum { DISTI_WARP_TILE = 12, DISTI_WARP_SIDE = DISTI_WARP_TILE + 4 };
typedef struct disti_warp_tile {
    int left, top, width, height; /* of the square; warp[0] is the pixel (left - 2, top - 2) */
    disti_warp warp[DISTI_WARP_SIDE * DISTI_WARP_SIDE];
    double d_color[DISTI_WARP_SIDE * DISTI_WARP_SIDE][3];
} disti_warp_tile;

/* Windows around the square's pixels and, for the gradient, those around its ring; d_ssim: of each one's mean. */
static void disti_warp_windows(const disti_photo_pair *pair, disti_warp_tile *tile, double d_ssim, double sum[2])
{
    const dist_photo *to = pair->to;
    for (int row = 1; row <= tile->height + 2; row++) {
        for (int column = 1; column <= tile->width + 2; column++) {
            int first = (row - 1) * DISTI_WARP_SIDE + column - 1, all = 1;
            int own = row >= 2 && row < tile->height + 2 && column >= 2 && column < tile->width + 2;
            for (int k = 0; k < 9; k++) all &= tile->warp[first + k / 3 * DISTI_WARP_SIDE + k % 3].visible;
            if (!all || (!own && d_ssim == 0.0)) continue;
            for (size_t channel = 0; channel < 3; channel++) {
                double x[9], y[9], d_x[9];
                for (int k = 0; k < 9; k++) {
                    size_t u = (size_t)(tile->left + column - 3 + k % 3), v = (size_t)(tile->top + row - 3 + k / 3);
                    x[k] = tile->warp[first + k / 3 * DISTI_WARP_SIDE + k % 3].color[channel];
                    y[k] = (double)to->color[3 * (v * (size_t)to->camera.width + u) + channel];
                }
                double ssim = disti_ssim(x, y, d_ssim, d_x);
                for (int k = 0; k < 9; k++) tile->d_color[first + k / 3 * DISTI_WARP_SIDE + k % 3][channel] += d_x[k];
                if (own) sum[0] += 0.5 - 0.5 * ssim;
            }
            if (own) sum[1] += 3.0;
        }
    }
}

/* backward  d_color = sum over its windows, + share sign(color - I_to);  g = d_color . dcolor/d(u, v);
             d_q = (g_u fx, g_u skew + g_v fy, -(g_u (fx q_x + skew q_y) + g_v fy q_y) / q_z) / q_z
             d_depth += d_q . M r
             from: d_t += d_q, d_w += (q - t) x d_q;   to: with y = M^T d_q  d_t -= y, d_w += y x (c - t) */
static void disti_warp_backward(const disti_photo_pair *pair, const disti_warp *warp, const double d_color[3],
                                size_t i, float *d_depth, double d_cameras[12])
{
    const disti_view *b = &pair->view_from;
    const double *q = warp->q;
    double g[2] = {0.0, 0.0}, d_q[3], y[3], arm[3], torque[3];
    for (int k = 0; k < 3; k++)
        for (int axis = 0; axis < 2; axis++) g[axis] += d_color[k] * warp->slope[k][axis];
    d_q[0] = g[0] * b->fx / q[2];
    d_q[1] = (g[0] * b->skew + g[1] * b->fy) / q[2];
    d_q[2] = -(d_q[0] * q[0] + d_q[1] * q[1]) / q[2];
    disti_rotate_back(pair->turn, d_q, y);
    if (d_depth) d_depth[i] += (float)disti_dot(y, warp->ray);
    for (int k = 0; k < 3; k++)
        arm[k] = warp->ray[k] * (double)pair->to->depth[i] - pair->view_to.translation[k];
    disti_cross(y, arm, torque);
    for (int k = 0; k < 3; k++) {
        d_cameras[k] += torque[k];
        d_cameras[3 + k] -= y[k];
        arm[k] = q[k] - b->translation[k];
        d_cameras[9 + k] += d_q[k];
    }
    disti_cross(arm, d_q, torque);
    for (int k = 0; k < 3; k++) d_cameras[6 + k] += torque[k];
}

/* One sweep over the picture. Without scale: sums and counts of both terms (L1, its count, SSIM's, its count) and the
   planes of desc; with it, weight / count of each, the gradient. */
static void disti_warp_sweep(const disti_photo_pair *pair, const dist_photometric_desc *desc, const double *scale,
                             double sum[4], float *d_depth, double d_cameras[12])
{
    disti_warp_tile tile;
    int width = pair->view_to.width, height = pair->view_to.height, rim = pair->ssim > 0.0 ? 2 : 0;
    for (tile.top = 0; tile.top < height; tile.top += DISTI_WARP_TILE) {
        for (tile.left = 0; tile.left < width; tile.left += DISTI_WARP_TILE) {
            tile.width = DISTI_MIN(DISTI_WARP_TILE, width - tile.left);
            tile.height = DISTI_MIN(DISTI_WARP_TILE, height - tile.top);
            memset(tile.d_color, 0, sizeof tile.d_color);
            for (int k = 0; k < DISTI_WARP_SIDE * DISTI_WARP_SIDE; k++) {
                int x = k % DISTI_WARP_SIDE - 2, y = k / DISTI_WARP_SIDE - 2;
                tile.warp[k].visible = 0;
                if (x < -rim || y < -rim || x >= tile.width + rim || y >= tile.height + rim) continue;
                x += tile.left;
                y += tile.top;
                if (x >= 0 && y >= 0 && x < width && y < height) disti_warp_pixel(pair, x, y, &tile.warp[k]);
            }
            if (rim) disti_warp_windows(pair, &tile, scale ? -0.5 * scale[1] : 0.0, sum + 2);
            for (int k = 0; k < tile.width * tile.height; k++) {
                int x = k % tile.width, y = k / tile.width, place = (y + 2) * DISTI_WARP_SIDE + x + 2;
                size_t i = (size_t)(tile.top + y) * (size_t)width + (size_t)(tile.left + x);
                const disti_warp *warp = &tile.warp[place];
                if (!scale && desc && desc->visible) desc->visible[i] = (unsigned char)warp->visible;
                for (size_t c = 0; c < 3; c++) {
                    double off = warp->visible ? warp->color[c] - (double)pair->to->color[3 * i + c] : 0.0;
                    if (!scale && desc && desc->warped)
                        desc->warped[3 * i + c] = warp->visible ? (float)warp->color[c] : 0.0f;
                    sum[0] += fabs(off);
                    sum[1] += warp->visible;
                    if (scale) tile.d_color[place][c] += scale[0] * disti_sign(off);
                }
                if (scale && warp->visible)
                    disti_warp_backward(pair, warp, tile.d_color[place], i, d_depth, d_cameras);
            }
        }
    }
}

DIST_API dist_photometric_desc dist_photometric_desc_resolve(const dist_photometric_desc *desc)
{
    dist_photometric_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.visibility == 0.0f) d.visibility = 1e-3f;
    return d;
}

DIST_API float dist_loss_photometric(const dist_photo *to, const dist_photo *from, const dist_photometric_desc *desc,
                                     float weight, float *d_depth, float d_cameras[12])
{
    disti_photo_pair pair;
    double sum[4] = {0.0, 0.0, 0.0, 0.0}, again[4] = {0.0, 0.0, 0.0, 0.0}, scale[2], d_pose[12], turned[3];
    const dist_photometric_desc how = dist_photometric_desc_resolve(desc);
    float ssim = how.ssim, visibility = how.visibility;
    if (!to || !from || !to->color || !to->depth || !from->color) return 0.0f;
    if (!disti_finite(ssim) || ssim < 0.0f || ssim > 1.0f || !disti_finite(visibility)) return 0.0f;
    if (disti_camera_check(NULL, &to->camera, "") != DIST_OK || disti_camera_check(NULL, &from->camera, "") != DIST_OK)
        return 0.0f;
    if (!disti_finite(weight)) weight = 0.0f; /* what is seen is told all the same */
    pair.to = to;
    pair.from = from;
    pair.ssim = (double)ssim;
    pair.visibility = (double)visibility;
    disti_view_of(&to->camera, &pair.view_to);
    disti_view_of(&from->camera, &pair.view_from);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            pair.turn[3 * i + j] = disti_dot(pair.view_from.rotation + 3 * i, pair.view_to.rotation + 3 * j);
    disti_rotate(pair.turn, pair.view_to.translation, turned);
    for (int i = 0; i < 3; i++) pair.shift[i] = pair.view_from.translation[i] - turned[i];
    disti_warp_sweep(&pair, desc, NULL, sum, NULL, NULL);
    scale[0] = sum[1] > 0.0 ? (1.0 - pair.ssim) * (double)weight / sum[1] : 0.0;
    scale[1] = sum[3] > 0.0 ? pair.ssim * (double)weight / sum[3] : 0.0;
    if (d_depth || d_cameras) {
        memset(d_pose, 0, sizeof d_pose);
        disti_warp_sweep(&pair, NULL, scale, again, d_depth, d_pose);
        for (int i = 0; d_cameras && i < 12; i++) disti_add_within(&d_cameras[i], d_pose[i]);
    }
    return disti_within_float(scale[0] * sum[0] + scale[1] * sum[2]);
}

/*@ 10 optimizer ---------------------------------------------------------------------------------------------------- */

#ifndef DIST_NO_BACKWARD
/* forward   m <- beta1 m + (1 - beta1) g,   v <- beta2 v + (1 - beta2) g^2
             x <- x - rate (m / (1 - beta1^t)) / (sqrt(v / (1 - beta2^t)) + epsilon)
   The second half of moments holds sqrt(v), not v: g^2 of 1e30 or 1e-30 does not fit a float, its root does. */
DIST_API size_t dist_adam_step(dist_adam *adam, size_t n, float *x, const float *gradient)
{
    size_t skipped = 0;
    if (!adam || !adam->moments || !x || !gradient || !disti_finite(adam->rate)) return n;
    double rate = adam->rate < 0.0f ? 0.0 : (adam->rate > 0.0f ? (double)adam->rate : 1e-2);
    double beta1 = disti_between(adam->beta1, 0.0f, 1.0f) ? (double)adam->beta1 : 0.9;
    double beta2 = disti_between(adam->beta2, 0.0f, 1.0f) ? (double)adam->beta2 : 0.999;
    double epsilon = disti_between(adam->epsilon, 0.0f, 3.4e38f) ? (double)adam->epsilon : 1e-8;
    if (adam->step < 0) adam->step = 0;
    if (adam->step < 0x7fffffff) adam->step++;
    double correction1 = 1.0 - pow(beta1, (double)adam->step);
    double correction2 = sqrt(1.0 - pow(beta2, (double)adam->step));
    float *first = adam->moments;
    float *second = adam->moments + n;
    for (size_t i = 0; i < n; i++) {
        double g = (double)gradient[i];
        if (!disti_finite(x[i]) || !disti_finite(gradient[i]) || !disti_finite(first[i]) || !disti_finite(second[i])) {
            skipped++;
            continue;
        }
        double m = beta1 * (double)first[i] + (1.0 - beta1) * g;
        double root = sqrt(beta2 * (double)second[i] * (double)second[i] + (1.0 - beta2) * g * g);
        first[i] = (float)m;
        second[i] = (float)root;
        double step = rate * (m / correction1) / (root / correction2 + epsilon);
        if (rate > 0.0) x[i] = disti_within_float((double)x[i] - step);
    }
    return skipped;
}
#endif

/*@ 11 mesh, metrics ------------------------------------------------------------------------------------------------ */

#ifndef DIST_NO_MESH
/* Sees to it that array (capacity, each) has room for one element behind `count`: half as large again where it has not.
   NULL on failure: then the old one stays and *capacity with it. */
static void *disti_grow(dist_context *ctx, void *array, size_t count, size_t *capacity, size_t each)
{
    size_t more, bytes;
    if (count < *capacity) return array;
    if (!disti_size_add(count, count / 2 + 64, &more) || !disti_size_mul(more, each, &bytes)) bytes = (size_t)-1;
    void *grown = disti_alloc(ctx, bytes);
    if (!grown) return NULL;
    if (array) memcpy(grown, array, count * each);
    disti_free(ctx, array, count * each);
    *capacity = more;
    return grown;
}

static dist_mesh *disti_mesh_new(dist_context *ctx)
{
    dist_mesh *mesh = (dist_mesh *)disti_alloc(ctx, sizeof(dist_mesh));
    if (!mesh) return NULL;
    memset(mesh, 0, sizeof *mesh);
    mesh->owner = ctx;
    return mesh;
}

DIST_API void dist_mesh_destroy(dist_mesh *mesh)
{
    if (!mesh) return;
    dist_context *ctx = mesh->owner;
    disti_free(ctx, mesh->triangles, mesh->triangle_capacity * 3 * sizeof(unsigned));
    disti_free(ctx, mesh->normals, mesh->vertex_capacity * 3 * sizeof(float));
    disti_free(ctx, mesh->vertices, mesh->vertex_capacity * 3 * sizeof(float));
    disti_free(ctx, mesh, sizeof *mesh);
}

/* Both append and return 1, or 0 after disti_fail. */
static int disti_mesh_add_vertex(dist_mesh *mesh, const float p[3])
{
    float *grown = (float *)disti_grow(mesh->owner, mesh->vertices, mesh->vertex_count, &mesh->vertex_capacity,
                                       3 * sizeof(float));
    if (!grown) return 0;
    mesh->vertices = grown;
    if (mesh->vertex_count >= 0xfffffffeu) {
        disti_fail(mesh->owner, DIST_UNSUPPORTED, "%s: more than 4294967294 vertices", mesh->owner->function, 0,
                   0);
        return 0;
    }
    memcpy(mesh->vertices + 3 * mesh->vertex_count++, p, 3 * sizeof(float));
    return 1;
}

static int disti_mesh_add_triangle(dist_mesh *mesh, unsigned a, unsigned b, unsigned c)
{
    unsigned *grown = (unsigned *)disti_grow(mesh->owner, mesh->triangles, mesh->triangle_count,
                                             &mesh->triangle_capacity, 3 * sizeof(unsigned));
    if (!grown) return 0;
    mesh->triangles = grown;
    grown += 3 * mesh->triangle_count++;
    grown[0] = a;
    grown[1] = b;
    grown[2] = c;
    return 1;
}

/* 0 after disti_fail if an array is missing. */
static int disti_mesh_arrays(dist_context *ctx, const char *name, size_t vertex_count, const float *vertices,
                             size_t triangle_count, const unsigned *triangles)
{
    if (vertex_count && !vertices) disti_refuse(ctx, "%s: vertices is NULL, but its count is not 0", name);
    else if (triangle_count && !triangles) disti_refuse(ctx, "%s: triangles is NULL, but its count is not 0", name);
    else return 1;
    return 0;
}

static int disti_mesh_whole(dist_context *ctx, const char *name, const dist_mesh *mesh)
{
    return disti_mesh_arrays(ctx, name, mesh->vertex_count, mesh->vertices, mesh->triangle_count, mesh->triangles);
}

/* 0 after disti_fail if a triangle has a vertex that is not there. first: what the sentence calls vertex 0. */
static int disti_mesh_check(dist_context *ctx, const dist_mesh *mesh, dist_status status, const char *format,
                            const char *text, int first)
{
    for (size_t i = 0; i < 3 * mesh->triangle_count; i++) {
        if (mesh->triangles[i] < mesh->vertex_count) continue;
        disti_fail(ctx, status, format, text, (double)mesh->triangles[i] + first, (double)mesh->vertex_count);
        return 0;
    }
    return 1;
}

DIST_API dist_mesh *dist_mesh_create(dist_context *ctx, size_t vertex_count, const float *vertices,
                                     size_t triangle_count, const unsigned *triangles)
{
    if (disti_enter(ctx, "dist_mesh_create") != DIST_OK) return NULL;
    if (!disti_mesh_arrays(ctx, "dist_mesh_create", vertex_count, vertices, triangle_count, triangles)) return NULL;
    if (vertex_count > 0xfffffffeu || triangle_count > (size_t)-1 / (3 * sizeof(unsigned))) {
        disti_fail(ctx, DIST_BAD_ARGUMENT, "dist_mesh_create: %d vertices and %d triangles are more than there can be",
                   NULL, (double)vertex_count, (double)triangle_count);
        return NULL;
    }
    dist_mesh *mesh = disti_mesh_new(ctx);
    int good = mesh != NULL;
    for (size_t i = 0; good && i < vertex_count; i++) {
        good = disti_finite_all(3, vertices + 3 * i);
        if (!good) disti_fail(ctx, DIST_NOT_FINITE, "dist_mesh_create: vertex %d is not finite", NULL, (double)i, 0);
        good = good && disti_mesh_add_vertex(mesh, vertices + 3 * i);
    }
    for (size_t i = 0; good && i < triangle_count; i++)
        good = disti_mesh_add_triangle(mesh, triangles[3 * i], triangles[3 * i + 1], triangles[3 * i + 2]);
    const char *format = "dist_mesh_create: a triangle has vertex %d, must be below %d";
    if (good && disti_mesh_check(ctx, mesh, DIST_BAD_ARGUMENT, format, NULL, 0)) return mesh;
    dist_mesh_destroy(mesh);
    return NULL;
}

/* Marching cubes. Corner c of a cell stands at (c & 1, c >> 1 & 1, c >> 2 & 1); bit c of a case is set where the
   corner is inside, f < level. An edge is axis * 8 + its lower corner. A case's triangles are derived: */
typedef struct disti_case {
    unsigned char triangles;
    unsigned char edges[3 * 6]; /* six triangles are the most that occur */
} disti_case;

static int disti_edge(int a, int b)
{
    return ((a ^ b) >> 1) * 8 + (a & b); /* 1, 2, 4 >> 1 is the axis */
}

static int disti_edges_share_face(int e, int f)
{
    for (int axis = 0; axis < 3; axis++)
        if (e >> 3 != axis && f >> 3 != axis && ((e ^ f) >> axis & 1) == 0) return 1;
    return 0;
}

/* Where the surface goes from a crossed edge. Walking around a face counterclockwise as seen from outside the cell,
   each edge that leaves the inside is joined to the edge where that run of inside corners was entered. The rule
   knows only the face's own corners, so the two cells at a face draw the same segments, in opposite directions; on
   an ambiguous face it keeps the two inside corners apart. Each crossed edge leaves on one of its faces and enters on
   the other: closed loops. */
static void disti_case_links(int code, unsigned char link[24])
{
    memset(link, 0xff, 24);
    for (int face = 0; face < 6; face++) {
        int axis = face >> 1, u = 1 << (axis + 1) % 3, v = 1 << (axis + 2) % 3, base = (face & 1) << axis;
        int corner[4] = {base, base | ((face & 1) ? u : v), base | u | v, base | ((face & 1) ? v : u)};
        for (int i = 0; i < 4; i++) {
            int j = i, next = corner[(i + 1) & 3];
            if (!(code >> corner[i] & 1) || (code >> next & 1)) continue;
            while (code >> corner[(j + 3) & 3] & 1) j = (j + 3) & 3;
            link[disti_edge(corner[(j + 3) & 3], corner[j])] = (unsigned char)disti_edge(corner[i], next);
        }
    }
}

/* Fans each loop from a vertex from which no diagonal lies in a face of the cell: a neighbor could draw the same
   diagonal, and four triangles would meet in it. There is always one. */
static void disti_cases(disti_case *cases)
{
    for (int code = 0; code < 256; code++) {
        unsigned char link[24], loop[24];
        disti_case *c = cases + code;
        c->triangles = 0;
        disti_case_links(code, link);
        for (int first = 0; first < 24; first++) {
            int n = 0, apex = 0;
            for (int e = first; link[e] != 0xff;) {
                int next = link[e];
                loop[n++] = (unsigned char)e;
                link[e] = 0xff;
                e = next;
            }
            for (int good = 0; !good && n > 3; apex += !good) {
                good = 1;
                for (int k = 2; k < n - 1; k++)
                    if (disti_edges_share_face(loop[apex], loop[(apex + k) % n])) good = 0;
                DIST_ASSERT(good || apex + 1 < n);
            }
            for (int k = 1; k + 1 < n; k++) {
                unsigned char *t = c->edges + 3 * c->triangles++;
                DIST_ASSERT(c->triangles <= 6);
                t[0] = loop[apex];
                t[1] = loop[(apex + k) % n];
                t[2] = loop[(apex + k + 1) % n];
            }
        }
    }
}

enum { DISTI_MESH_BATCH = 8192 };

/* (cells + 1)^2 corners of one height, and what hangs on them. */
typedef struct disti_extract_plane {
    float *value;
    unsigned char *known; /* 1: value is there */
    unsigned *edge[3];    /* [axis]: vertex on the edge from this corner along the axis; ~0 none yet */
} disti_extract_plane;

/* The cube is walked layer by layer. */
typedef struct disti_extract {
    dist_context *ctx;
    const dist_field *field;
    dist_mesh *mesh;
    disti_case *cases;
    float level;
    size_t cells, side; /* side = cells + 1 corners */
    size_t block;       /* cells along a block's side; blocks are left out as a whole */
    size_t blocks;      /* along a side of the cube */
    int no_skip;
    disti_extract_plane plane[2]; /* the layer's lower and upper corners */
    unsigned char *active; /* (blocks, blocks) of the blocks that the layer cuts; 1: may hold the surface */
    float *batch;          /* (DISTI_MESH_BATCH, 15) */
    unsigned *where;       /* (DISTI_MESH_BATCH) */
} disti_extract;

static float disti_extract_coordinate(const disti_extract *x, int axis, double cells)
{
    return (float)((double)x->field->center[axis] + (double)x->field->radius * (2.0 * cells / (double)x->cells - 1.0));
}

/* f at the first n points of the batch into the floats behind them; 0 after disti_fail if one is not finite. */
static int disti_extract_eval(disti_extract *x, size_t n)
{
    float *sdf = x->batch + 3 * DISTI_MESH_BATCH;
    disti_field_eval_all(x->ctx, x->field, n, x->batch, sdf, NULL);
    if (disti_finite_all(n, sdf)) return 1;
    disti_fail(x->ctx, DIST_NOT_FINITE, "dist_mesh_extract: the field is not finite everywhere in the cube", NULL, 0,
               0);
    return 0;
}

/* Marks the blocks of slab `slab` that may hold the surface: |f(center) - level| <= lipschitz * half diagonal. A
   clamped f says no more than that the distance is at least the clamp. */
static int disti_extract_mark(disti_extract *x, size_t slab)
{
    const dist_field *field = x->field;
    const float *sdf = x->batch + 3 * DISTI_MESH_BATCH;
    double half = 0.5 * (double)x->block;
    double reach = (double)disti_steepest(field) * 1.7320508075688772 * half * 2.0 * (double)field->radius /
                   (double)x->cells;
    /* the figure is often an estimate, and too small a one leaves holes; but a plateau beyond it is left out */
    double plateau = field->clamp > 0.0f ? 0.95 * ((double)field->clamp - fabs((double)x->level)) : 3e38;
    reach = DISTI_MIN(2.0 * reach, DISTI_MAX(1.1 * reach, plateau));
    size_t total = x->blocks * x->blocks;
    if (x->no_skip) {
        memset(x->active, 1, total);
        return 1;
    }
    for (size_t from = 0; from < total; from += DISTI_MESH_BATCH) {
        size_t n = DISTI_MIN(total - from, (size_t)DISTI_MESH_BATCH);
        for (size_t i = 0; i < n; i++) {
            size_t at[3] = {(from + i) % x->blocks, (from + i) / x->blocks, slab};
            for (int k = 0; k < 3; k++) { /* the middle of what lies in the cube */
                size_t begin = at[k] * x->block, end = DISTI_MIN(begin + x->block, x->cells);
                x->batch[3 * i + (size_t)k] = disti_extract_coordinate(x, k, 0.5 * (double)(begin + end));
            }
        }
        if (!disti_extract_eval(x, n)) return 0;
        for (size_t i = 0; i < n; i++) {
            double f = (double)sdf[i];
            if (field->clamp > 0.0f) f = DISTI_MAX(DISTI_MIN(f, (double)field->clamp), -(double)field->clamp);
            x->active[from + i] = fabs(f - (double)x->level) <= reach;
        }
    }
    return 1;
}

static int disti_extract_flush(disti_extract *x, const disti_extract_plane *plane, size_t n)
{
    if (n == 0) return 1;
    if (!disti_extract_eval(x, n)) return 0;
    for (size_t i = 0; i < n; i++) plane->value[x->where[i]] = x->batch[3 * DISTI_MESH_BATCH + i];
    return 1;
}

/* Evaluates the plane's corners of active blocks, at height z. */
static int disti_extract_fill(disti_extract *x, const disti_extract_plane *plane, size_t z)
{
    size_t n = 0;
    unsigned char *known = plane->known;
    float height = disti_extract_coordinate(x, 2, (double)z);
    for (size_t b = 0; b < x->blocks * x->blocks; b++) {
        if (!x->active[b]) continue;
        size_t x0 = b % x->blocks * x->block, y0 = b / x->blocks * x->block;
        size_t x1 = DISTI_MIN(x0 + x->block, x->cells), y1 = DISTI_MIN(y0 + x->block, x->cells);
        for (size_t i = y0 * x->side + x0; i <= y1 * x->side + x1; i += i % x->side == x1 ? x->side - (x1 - x0) : 1) {
            if (known[i]) continue;
            known[i] = 1;
            x->where[n] = (unsigned)i;
            x->batch[3 * n] = disti_extract_coordinate(x, 0, (double)(i % x->side));
            x->batch[3 * n + 1] = disti_extract_coordinate(x, 1, (double)(i / x->side));
            x->batch[3 * n + 2] = height;
            if (++n < DISTI_MESH_BATCH) continue;
            if (!disti_extract_flush(x, plane, n)) return 0;
            n = 0;
        }
    }
    return disti_extract_flush(x, plane, n);
}

/* The vertex on an edge of the cell at (cx, cy, cz), made where it is asked for first; 0 after disti_fail. */
static int disti_extract_vertex(disti_extract *x, int edge, const size_t cell[3], unsigned *vertex)
{
    int axis = edge >> 3, layer = edge >> 2 & 1;
    size_t step[3] = {1, x->side, 0}, corner[3];
    for (int k = 0; k < 3; k++) corner[k] = cell[k] + (size_t)(edge >> k & 1);
    size_t at = corner[1] * x->side + corner[0];
    unsigned *slot = x->plane[layer].edge[axis] + at;
    if (*slot == ~0u) {
        double low = (double)x->plane[layer].value[at];
        double high = (double)x->plane[axis == 2 ? 1 : layer].value[at + step[axis]];
        double t = ((double)x->level - low) / (high - low); /* one is below the level, the other is not */
        float p[3];
        for (int k = 0; k < 3; k++) p[k] = disti_extract_coordinate(x, k, (double)corner[k] + (k == axis ? t : 0.0));
        if (!disti_mesh_add_vertex(x->mesh, p)) return 0;
        *slot = (unsigned)(x->mesh->vertex_count - 1);
    }
    *vertex = *slot;
    return 1;
}

static int disti_extract_cell(disti_extract *x, const size_t cell[3])
{
    int code = 0;
    size_t at = cell[1] * x->side + cell[0];
    const float *value[2] = {x->plane[0].value, x->plane[1].value};
    for (int c = 0; c < 8; c++)
        code |= (value[c >> 2][at + (size_t)(c >> 1 & 1) * x->side + (size_t)(c & 1)] < x->level) << c;
    const disti_case *found = x->cases + code;
    for (int i = 0; i < found->triangles; i++) {
        unsigned v[3];
        for (int k = 0; k < 3; k++)
            if (!disti_extract_vertex(x, found->edges[3 * i + k], cell, v + k)) return 0;
        if (!disti_mesh_add_triangle(x->mesh, v[0], v[1], v[2])) return 0;
    }
    return 1;
}

/* The cells of layer z in active blocks. */
static int disti_extract_layer(disti_extract *x, size_t z)
{
    for (size_t b = 0; b < x->blocks * x->blocks; b++) {
        if (!x->active[b]) continue;
        size_t x0 = b % x->blocks * x->block, y0 = b / x->blocks * x->block;
        size_t width = DISTI_MIN(x->block, x->cells - x0), height = DISTI_MIN(x->block, x->cells - y0);
        for (size_t i = 0; i < width * height; i++) {
            size_t cell[3] = {x0 + i % width, y0 + i / width, z};
            if (!disti_extract_cell(x, cell)) return 0;
        }
    }
    return 1;
}

/* Nothing is known yet of a plane. */
static void disti_extract_forget(const disti_extract *x, const disti_extract_plane *plane)
{
    size_t corners = x->side * x->side;
    memset(plane->known, 0, corners);
    for (int axis = 0; axis < 3; axis++) memset(plane->edge[axis], 0xff, corners * sizeof(unsigned));
}

static int disti_extract_surface(disti_extract *x)
{
    for (int layer = 0; layer < 2; layer++) disti_extract_forget(x, &x->plane[layer]);
    for (size_t z = 0; z < x->cells; z++) {
        if (z % x->block == 0) {
            /* a block below may have been left out: the shared corners are then still to be evaluated */
            if (!disti_extract_mark(x, z / x->block) || !disti_extract_fill(x, &x->plane[0], z)) return 0;
        }
        if (!disti_extract_fill(x, &x->plane[1], z + 1) || !disti_extract_layer(x, z)) return 0;
        disti_extract_plane lower = x->plane[0];
        x->plane[0] = x->plane[1];
        x->plane[1] = lower;
        disti_extract_forget(x, &x->plane[1]);
    }
    return 1;
}

/* Newton steps p <- p - (f - level) grad / |grad|^2, at most half a cell each, for up to a batch of vertices. A step
   that brings f no nearer to the level is taken back and tried again at half its length. normals may be NULL. */
static void disti_extract_polish(disti_extract *x, size_t n, int steps, float *vertices, float *normals)
{
    float *points = x->batch, *sdf = points + 3 * DISTI_MESH_BATCH, *gradient = sdf + DISTI_MESH_BATCH;
    float *best = gradient + 3 * DISTI_MESH_BATCH, *slope = best + DISTI_MESH_BATCH,
          *scale = slope + 3 * DISTI_MESH_BATCH;
    double longest = (double)x->field->radius / (double)x->cells;
    memcpy(points, vertices, 3 * n * sizeof(float));
    for (int step = 0; step <= steps; step++) {
        disti_field_eval_all(x->ctx, x->field, n, points, sdf, gradient);
        for (size_t i = 0; i < n; i++) {
            float *v = vertices + 3 * i, *s = slope + 3 * i, *p = points + 3 * i;
            float f = sdf[i] - x->level;
            int good = disti_finite(f) && disti_finite_all(3, gradient + 3 * i);
            if (step == 0 || (good && fabsf(f) < fabsf(best[i]))) {
                best[i] = good ? f : 0.0f;
                memcpy(v, p, 3 * sizeof(float));
                for (size_t k = 0; k < 3; k++) s[k] = good ? gradient[3 * i + k] : 0.0f;
                scale[i] = step == 0 ? 1.0f : scale[i];
            } else {
                scale[i] *= 0.5f;
            }
            double square = (double)s[0] * (double)s[0] + (double)s[1] * (double)s[1] + (double)s[2] * (double)s[2];
            double length = sqrt(square);
            double move = length > 0.0 ? (double)best[i] / length : 0.0;
            move = (double)scale[i] * DISTI_MAX(DISTI_MIN(move, longest), -longest);
            for (size_t k = 0; k < 3; k++) {
                double unit = length > 0.0 ? (double)s[k] / length : 0.0, side = (double)x->field->radius;
                double to = (double)v[k] - move * unit, from = (double)x->field->center[k];
                p[k] = (float)DISTI_MIN(DISTI_MAX(to, from - side), from + side);
                if (normals && step == steps) normals[3 * i + k] = (float)unit;
            }
        }
    }
}

/* One block for all planes: at most 2049^2 of 34 bytes, and the batch: fits 32 bits. base NULL: only its size. */
static size_t disti_extract_layout(disti_extract *x, unsigned char *base)
{
    size_t at = 0, corners = x->side * x->side;
    x->batch = (float *)disti_take(base, &at, 15 * DISTI_MESH_BATCH, sizeof(float));
    x->where = (unsigned *)disti_take(base, &at, DISTI_MESH_BATCH, sizeof(unsigned));
    for (int layer = 0; layer < 2; layer++) {
        disti_extract_plane *plane = &x->plane[layer];
        plane->value = (float *)disti_take(base, &at, corners, sizeof(float));
        plane->known = (unsigned char *)disti_take(base, &at, corners, 1);
        for (int axis = 0; axis < 3; axis++)
            plane->edge[axis] = (unsigned *)disti_take(base, &at, corners, sizeof(unsigned));
    }
    x->active = (unsigned char *)disti_take(base, &at, x->blocks * x->blocks, 1);
    return at;
}

/* Blocks of 4 cells, of 2 where a clamped field could never rule one out; if these are still too large, all cells. */
static void disti_extract_blocks(disti_extract *x)
{
    double slope = 2.0 * (double)disti_steepest(x->field);
    double diagonal = slope * 1.7320508075688772 * (double)x->field->radius / (double)x->cells; /* half of one cell's */
    double visible = (double)x->field->clamp - fabs((double)x->level);
    x->block = 4;
    while (x->field->clamp > 0.0f && x->block > 2 && diagonal * (double)x->block > 0.5 * visible) x->block /= 2;
    if (x->field->clamp > 0.0f && diagonal * (double)x->block > visible) x->no_skip = 1;
    x->blocks = (x->cells + x->block - 1) / x->block;
}

static dist_status disti_extract_check(dist_context *ctx, const dist_field *field, const dist_mesh_desc *desc)
{
    const char *name = "dist_mesh_extract";
    dist_mesh_desc d = dist_mesh_desc_resolve(desc);
    dist_status status = disti_field_check(ctx, field, name);
    if (status != DIST_OK) return status;
    if (desc && desc->resolution != 0 && (desc->resolution < 2 || desc->resolution > 2048))
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: resolution is %d, must be 2 to 2048, or 0", name,
                          desc->resolution, 0);
    float farthest = 0.0f;
    for (int k = 0; k < 3; k++) farthest = DISTI_MAX(farthest, fabsf(field->center[k]) + field->radius);
    if (2.0f * field->radius < 5e-7f * farthest * (float)d.resolution)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: resolution is %d, must be at most %d, where cells are as small "
                                                  "as floats are apart so far from 0", name, d.resolution,
                          floor(2.0 * (double)field->radius / (5e-7 * (double)farthest)));
    if (!desc) return DIST_OK;
    if (!disti_finite(desc->level))
        return disti_fail(ctx, DIST_NOT_FINITE, "%s: level is %d, must be finite", name, (double)desc->level, 0);
    const disti_limit limits[] = {{"no_skip", (double)desc->no_skip, 0, 1}, {"normals", (double)desc->normals, 0, 1},
                                  {"refine", (double)desc->refine, 0, 8}};
    return disti_limits(ctx, name, sizeof limits / sizeof limits[0], limits);
}

DIST_API dist_mesh_desc dist_mesh_desc_resolve(const dist_mesh_desc *desc)
{
    dist_mesh_desc d;
    memset(&d, 0, sizeof d);
    if (desc) d = *desc;
    if (d.resolution == 0) d.resolution = 128;
    return d;
}

DIST_API dist_mesh *dist_mesh_extract(dist_context *ctx, const dist_field *field, const dist_mesh_desc *desc)
{
    disti_extract x;
    disti_case cases[256];
    if (disti_enter(ctx, "dist_mesh_extract") != DIST_OK) return NULL;
    if (disti_extract_check(ctx, field, desc) != DIST_OK) return NULL;
    dist_mesh_desc d = dist_mesh_desc_resolve(desc);
    memset(&x, 0, sizeof x);
    x.ctx = ctx;
    x.field = field;
    x.cases = cases;
    x.level = d.level;
    x.cells = (size_t)d.resolution;
    x.side = x.cells + 1;
    x.no_skip = d.no_skip;
    disti_extract_blocks(&x);
    disti_cases(cases);
    x.mesh = disti_mesh_new(ctx);
    size_t bytes = disti_extract_layout(&x, NULL);
    void *memory = x.mesh ? disti_alloc(ctx, bytes) : NULL;
    disti_extract_layout(&x, (unsigned char *)memory);
    int good = memory && disti_extract_surface(&x);
    if (good && d.normals) {
        x.mesh->normals = (float *)disti_alloc(ctx, x.mesh->vertex_capacity * 3 * sizeof(float)); /* as the vertices */
        good = x.mesh->normals != NULL;
    }
    for (size_t at = 0; good && (d.refine || d.normals) && at < x.mesh->vertex_count; at += DISTI_MESH_BATCH)
        disti_extract_polish(&x, DISTI_MIN(x.mesh->vertex_count - at, (size_t)DISTI_MESH_BATCH), d.refine,
                             x.mesh->vertices + 3 * at, d.normals ? x.mesh->normals + 3 * at : NULL);
    disti_free(ctx, memory, bytes);
    if (good) return x.mesh;
    dist_mesh_destroy(x.mesh);
    return NULL;
}

#ifndef DIST_NO_BACKWARD
/* forward   f(v) = level, so that a change of f moves the vertex by dv = -n df / |grad f|, n = grad f / |grad f|
   backward  d_f_i = -(n . d_v_i) / |grad f| = -(grad f . d_v_i) / |grad f|^2; 0 where grad f is */
static void disti_mesh_seed(void *user, size_t first, size_t count, const float *sdf, const float *gradient,
                            float *d_sdf)
{
    const float *d_vertices = *(const float *const *)user;
    (void)sdf;
    for (size_t i = 0; i < count; i++) {
        const float *g = gradient + 3 * i, *d_v = d_vertices + 3 * (first + i);
        double dot = 0.0, square = 0.0;
        for (size_t k = 0; k < 3; k++) {
            dot += (double)g[k] * (double)d_v[k];
            square += (double)g[k] * (double)g[k];
        }
        d_sdf[i] = disti_finite_all(3, g) && square > 0.0 ? disti_within_float(-dot / square) : 0.0f;
    }
}

DIST_API dist_status dist_mesh_backward(dist_context *ctx, const dist_field *field, const dist_mesh *mesh,
                                        const float *d_vertices, const dist_gradients *grads)
{
    enum { CHUNK = 4096 };
    const char *name = "dist_mesh_backward";
    float d_sdf[CHUNK];
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    if (!mesh || (mesh->vertex_count && !d_vertices))
        return disti_refuse(ctx, "dist_mesh_backward: %s is NULL", mesh ? "d_vertices" : "mesh");
    if (!disti_mesh_whole(ctx, name, mesh)) return DIST_BAD_ARGUMENT;
    for (size_t i = 0; i < mesh->vertex_count; i++)
        if (!disti_finite_all(3, d_vertices + 3 * i))
            return disti_fail(ctx, DIST_NOT_FINITE, "%s: d_vertices of vertex %d is not finite", name, (double)i, 0);
    status = disti_field_backward(ctx, name, field, 0, NULL, NULL, NULL, NULL, NULL, grads);
    for (size_t at = 0; status == DIST_OK && at < mesh->vertex_count; at += CHUNK) {
        const float *d_chunk = d_vertices + 3 * at, *points = mesh->vertices + 3 * at;
        size_t n = DISTI_MIN(mesh->vertex_count - at, (size_t)CHUNK);
        float *gradient = disti_chunk_scratch(ctx);
        if (grads->weights) { /* their pass has no gradient to seed from */
            disti_field_eval_all(ctx, field, n, points, d_sdf, gradient);
            disti_mesh_seed(&d_chunk, 0, n, NULL, gradient, d_sdf);
        }
        status = disti_field_backward(ctx, name, field, n, points, d_sdf, grads->weights ? NULL : disti_mesh_seed,
                                      &d_chunk, NULL, grads);
    }
    return status;
}
#endif

static double disti_triangle_area(const dist_mesh *mesh, size_t i)
{
    const unsigned *t = mesh->triangles + 3 * i;
    double u[3], v[3], c[3];
    for (int k = 0; k < 3; k++) {
        double a = (double)mesh->vertices[3 * (size_t)t[0] + (size_t)k];
        u[k] = (double)mesh->vertices[3 * (size_t)t[1] + (size_t)k] - a;
        v[k] = (double)mesh->vertices[3 * (size_t)t[2] + (size_t)k] - a;
    }
    disti_cross(u, v, c);
    return 0.5 * sqrt(disti_dot(c, c));
}

/* p = (1 - s) a + s (1 - w) b + s w c, s = sqrt(unit), is uniform over the triangle. */
static void disti_mesh_draw(const dist_mesh *mesh, size_t triangle, double s, double w, float *p)
{
    const unsigned *t = mesh->triangles + 3 * triangle;
    for (size_t k = 0; k < 3; k++) {
        double a = (double)mesh->vertices[3 * (size_t)t[0] + k], b = (double)mesh->vertices[3 * (size_t)t[1] + k];
        double c = (double)mesh->vertices[3 * (size_t)t[2] + k];
        p[k] = (float)((1.0 - s) * a + s * ((1.0 - w) * b + w * c));
    }
}

DIST_API dist_status dist_mesh_sample(dist_context *ctx, const dist_mesh *mesh, unsigned seed, size_t n, float *points)
{
    const char *name = "dist_mesh_sample";
    size_t bytes, count = mesh ? mesh->triangle_count : 0;
    uint64_t random = seed;
    double sum = 0.0;
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    status = disti_count_check(ctx, n, name);
    if (status != DIST_OK) return status;
    if (!mesh || (n && !points)) return disti_refuse(ctx, "dist_mesh_sample: %s is NULL", mesh ? "points" : "mesh");
    if (count == 0) return disti_refuse(ctx, "%s: the mesh has no triangles", name);
    if (!disti_mesh_whole(ctx, name, mesh)) return DIST_BAD_ARGUMENT;
    if (!disti_mesh_check(ctx, mesh, DIST_BAD_ARGUMENT, "%s: a triangle has vertex %d, must be below %d", name, 0))
        return DIST_BAD_ARGUMENT;
    disti_size_mul(count, sizeof(double), &bytes);
    double *until = (double *)disti_alloc(ctx, bytes); /* area of the triangles up to and with this one */
    if (!until) return DIST_OUT_OF_MEMORY;
    for (size_t i = 0; i < count; i++) until[i] = sum += disti_triangle_area(mesh, i);
    if (!disti_finite_double(sum) || !(sum > 0.0)) {
        status = disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: the mesh's area is %d, must be positive", name, sum, 0);
        n = 0;
    }
    for (size_t i = 0; i < n; i++) {
        double target = disti_random_unit(&random) * sum;
        size_t low = 0, high = count - 1;
        while (low < high) { /* the first triangle that ends beyond the target: never one without area */
            size_t middle = low + (high - low) / 2;
            if (until[middle] > target) high = middle;
            else low = middle + 1;
        }
        double s = sqrt(disti_random_unit(&random));
        disti_mesh_draw(mesh, low, s, disti_random_unit(&random), points + 3 * i);
    }
    disti_free(ctx, until, bytes);
    return status;
}

/* A balanced tree over a copy of the points: node i has children 2i + 1 and 2i + 2, halves its range at the middle
   along its longest side, and keeps the box around its points. Balance follows from ranks, not from coordinates, so
   equal points, lines and outliers cost nothing extra; the tight boxes do the pruning. */
typedef struct disti_tree {
    float *points; /* (n, 3), permuted */
    float *boxes;  /* (nodes, 6): low, high; behind the points */
    size_t n, nodes, bytes;
    int depth;
} disti_tree;

static void disti_swap_points(float *a, float *b)
{
    float t[3];
    memcpy(t, a, sizeof t);
    memcpy(a, b, sizeof t);
    memcpy(b, t, sizeof t);
}

/* Puts the point of rank `rank` along `axis` in its place, smaller ones before and larger ones after it. The pivot
   is drawn at random and both scans stop at equals: linear for every order of the points, also with many equal ones. */
static void disti_tree_select(float *points, ptrdiff_t low, ptrdiff_t high, ptrdiff_t rank, size_t axis)
{
    uint64_t random = (uint64_t)(high - low);
    while (low < high) { /* high is the last, not one beyond it */
        float pivot =
            points[3 * (low + (ptrdiff_t)(disti_random_bits(&random) % (uint64_t)(high - low + 1))) + (ptrdiff_t)axis];
        ptrdiff_t i = low, j = high;
        while (i <= j) {
            while (points[3 * (size_t)i + axis] < pivot) i++;
            while (points[3 * (size_t)j + axis] > pivot) j--;
            if (i <= j) disti_swap_points(points + 3 * i++, points + 3 * j--);
        }
        if (rank > j && rank < i) return; /* what lies between equals the pivot */
        if (rank <= j) high = j;
        else low = i;
    }
}

static void disti_tree_build(disti_tree *tree, size_t node, size_t low, size_t high, int level)
{
    float *box = tree->boxes + 6 * node;
    memcpy(box, tree->points + 3 * low, 3 * sizeof(float));
    memcpy(box + 3, tree->points + 3 * low, 3 * sizeof(float));
    for (size_t i = low + 1; i < high; i++)
        for (size_t k = 0; k < 3; k++) {
            float p = tree->points[3 * i + k];
            box[k] = DISTI_MIN(box[k], p);
            box[3 + k] = DISTI_MAX(box[3 + k], p);
        }
    if (level == tree->depth) return;
    size_t axis = 0, middle = low + (high - low) / 2;
    for (size_t k = 1; k < 3; k++)
        if ((double)box[3 + k] - (double)box[k] > (double)box[3 + axis] - (double)box[axis]) axis = k;
    disti_tree_select(tree->points, (ptrdiff_t)low, (ptrdiff_t)high - 1, (ptrdiff_t)middle, axis);
    disti_tree_build(tree, 2 * node + 1, low, middle, level + 1);
    disti_tree_build(tree, 2 * node + 2, middle, high, level + 1);
}

/* Copies and sorts n > 0 points; leaves hold 4 to 8. 0 after disti_fail. */
static int disti_tree_begin(dist_context *ctx, disti_tree *tree, size_t n, const float *points)
{
    size_t floats;
    tree->n = n;
    while (n >> tree->depth > 8) tree->depth++;
    tree->nodes = ((size_t)2 << tree->depth) - 1; /* at most n / 2 or 1 */
    if (!disti_size_mul(n, 3, &floats) || !disti_size_add(floats, 6 * tree->nodes, &floats) ||
        !disti_size_mul(floats, sizeof(float), &tree->bytes))
        tree->bytes = (size_t)-1;
    tree->points = (float *)disti_alloc(ctx, tree->bytes);
    if (!tree->points) return 0;
    tree->boxes = tree->points + 3 * n;
    memcpy(tree->points, points, 3 * n * sizeof(float));
    disti_tree_build(tree, 0, 0, n, 0);
    return 1;
}

static double disti_square_distance(const float *p, const float *q)
{
    double x = (double)p[0] - (double)q[0], y = (double)p[1] - (double)q[1], z = (double)p[2] - (double)q[2];
    return x * x + y * y + z * z;
}

static double disti_box_distance(const float *box, const float *p)
{
    double sum = 0.0;
    for (int k = 0; k < 3; k++) {
        double below = (double)box[k] - (double)p[k], above = (double)p[k] - (double)box[3 + k];
        double d = DISTI_MAX(DISTI_MAX(below, above), 0.0);
        sum += d * d;
    }
    return sum;
}

/* Looks for a point of the node nearer to p than *best, squared: its number goes to *hint. Nearer children first. */
static void disti_tree_search(const disti_tree *tree, size_t node, size_t low, size_t high, const float *p,
                              double *best, size_t *hint)
{
    if (2 * node + 2 < tree->nodes) {
        size_t middle = low + (high - low) / 2, child = 2 * node + 1;
        double away[2] = {disti_box_distance(tree->boxes + 6 * child, p),
                          disti_box_distance(tree->boxes + 6 * child + 6, p)};
        for (int k = 0; k < 2; k++) {
            int side = k ^ (away[1] < away[0]);
            if (away[side] < *best)
                disti_tree_search(tree, child + (size_t)side, side ? middle : low, side ? high : middle, p, best, hint);
        }
        return;
    }
    for (size_t i = low; i < high; i++) {
        double d = disti_square_distance(tree->points + 3 * i, p);
        if (!(d < *best)) continue;
        *best = d;
        *hint = i;
    }
}

typedef struct disti_chamfer_job {
    const disti_tree *from, *to;
    disti_pieces pieces;
    double *sums; /* one for each piece */
} disti_chamfer_job;

/* The points come in the order of their own tree: neighbors follow each other and the last answer is a good first
   guess. */
static void disti_chamfer_task(void *arg, int index, int worker)
{
    const disti_chamfer_job *job = (const disti_chamfer_job *)arg;
    size_t first, n = disti_piece(&job->pieces, index, &first), hint = 0;
    double sum = 0.0;
    (void)worker;
    for (const float *p = job->from->points + 3 * first; n-- > 0; p += 3) {
        double best = disti_square_distance(job->to->points + 3 * hint, p);
        disti_tree_search(job->to, 0, 0, job->to->n, p, &best, &hint);
        sum += best;
    }
    job->sums[index] = sum;
}

static dist_status disti_chamfer_one_way(dist_context *ctx, const disti_tree *from, const disti_tree *to, double *mean)
{
    disti_chamfer_job job = {from, to, disti_cut(from->n, 1024, 1u << 16), NULL};
    double sum = 0.0;
    size_t bytes = (size_t)job.pieces.count * sizeof(double); /* at most 2^16 pieces */
    job.sums = (double *)disti_alloc(ctx, bytes);
    if (!job.sums) return DIST_OUT_OF_MEMORY;
    disti_run(ctx, job.pieces.count, disti_chamfer_task, &job);
    for (int i = 0; i < job.pieces.count; i++) sum += job.sums[i];
    disti_free(ctx, job.sums, bytes);
    *mean = sum / (double)from->n;
    return DIST_OK;
}

static dist_status disti_chamfer_check(dist_context *ctx, size_t n, const float *points, const char *what)
{
    if (n == 0) return disti_refuse(ctx, "dist_chamfer: %s has no points", what);
    if (!disti_count_fits(n))
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "dist_chamfer: %s has %d points, more than memory can hold", what,
                          (double)n, 0);
    if (!points) return disti_refuse(ctx, "dist_chamfer: %s is NULL", what);
    for (size_t i = 0; i < n; i++)
        if (!disti_finite_all(3, points + 3 * i))
            return disti_fail(ctx, DIST_NOT_FINITE, "dist_chamfer: point %d of %s is not finite", what, (double)i, 0);
    return DIST_OK;
}

DIST_API dist_status dist_chamfer(dist_context *ctx, size_t n, const float *a, size_t m, const float *b,
                                  double *chamfer, double one_way[2])
{
    disti_tree trees[2];
    double parts[2];
    dist_status status = disti_enter(ctx, "dist_chamfer");
    if (status == DIST_OK) status = disti_chamfer_check(ctx, n, a, "a");
    if (status == DIST_OK) status = disti_chamfer_check(ctx, m, b, "b");
    if (status != DIST_OK) return status;
    if (!chamfer && !one_way) return disti_refuse(ctx, "dist_chamfer: chamfer is NULL", NULL);
    memset(trees, 0, sizeof trees);
    if (!disti_tree_begin(ctx, trees, n, a) || !disti_tree_begin(ctx, trees + 1, m, b)) status = DIST_OUT_OF_MEMORY;
    if (status == DIST_OK) status = disti_chamfer_one_way(ctx, trees, trees + 1, parts);
    if (status == DIST_OK) status = disti_chamfer_one_way(ctx, trees + 1, trees, parts + 1);
    if (status == DIST_OK && chamfer) *chamfer = parts[0] + parts[1];
    if (status == DIST_OK && one_way) memcpy(one_way, parts, sizeof parts);
    for (int i = 2; i-- > 0;) disti_free(ctx, trees[i].points, trees[i].bytes);
    return status;
}
#endif

/*@ 12 files -------------------------------------------------------------------------------------------------------- */

/* Text at hand while a file in memory is read; it has no terminating 0. */
typedef struct disti_text {
    const char *at;
    const char *end;
} disti_text;

static int disti_is_space(char c)
{
    return c == ' ' || (c >= '\t' && c <= '\r');
}

static void disti_skip_space(disti_text *t)
{
    while (t->at < t->end && disti_is_space(*t->at)) t->at++;
}

/* A whole number, up to 2^53; 0 if there is none here. */
static int disti_text_integer(disti_text *t, int64_t *out)
{
    const char *c = t->at;
    int negative = c < t->end && *c == '-';
    int64_t value = 0;
    if (c < t->end && (*c == '-' || *c == '+')) c++;
    const char *digits = c;
    for (; c < t->end && *c >= '0' && *c <= '9'; c++) {
        if (value >= (int64_t)1 << 53) return 0;
        value = value * 10 + (*c - '0');
    }
    if (c == digits) return 0;
    t->at = c;
    *out = negative ? -value : value;
    return 1;
}

/* A number as people write it: also .5 and 5. which disti_parse_double does not take; 0 if there is none here. */
static int disti_text_number(disti_text *t, double *out)
{
    char copy[64];
    size_t n = 0;
    const char *c = t->at, *cursor = copy;
    for (; c < t->end && n + 2 < sizeof copy &&
           (*c == '+' || (*c >= '-' && *c <= '9' && *c != '/') || *c == 'e' || *c == 'E');
         c++) {
        if (*c == '.' && (n == 0 || copy[n - 1] < '0')) copy[n++] = '0';
        if (*c != '.' || (c + 1 < t->end && (c[1] == '.' || (c[1] >= '0' && c[1] <= '9')))) copy[n++] = *c;
    }
    if (n + 2 >= sizeof copy) return disti_parse_double(&t->at, t->end, out);
    if (!disti_parse_double(&cursor, copy + n, out) || cursor != copy + n) return 0;
    t->at = c;
    return 1;
}

DIST_API dist_status dist_pfm_write(dist_context *ctx, int width, int height, int channels, const float *pixels,
                                    void *buffer, size_t capacity, size_t *size)
{
    const char *name = "dist_pfm_write";
    size_t floats = 0;
    unsigned char header[64];
    disti_writer sink = {header, 0};
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    if (width < 1 || height < 1)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: the picture is %d x %d, must be at least 1 x 1", name, width,
                          height);
    if (channels != 1 && channels != 3)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: channels is %d, must be 1 or 3", name, channels, 0);
    if (!disti_size_mul((size_t)width, (size_t)height, &floats) ||
        !disti_size_mul(floats, (size_t)channels, &floats) || floats > ((size_t)-1 - 64) / 4)
        return disti_fail(ctx, DIST_OUT_OF_MEMORY, "%s: %d x %d pixels do not fit memory", name, width, height);
    if (!size) return disti_refuse(ctx, "%s: size is NULL", name);
    disti_put_text(&sink, channels == 3 ? "PF\n" : "Pf\n");
    disti_put_size(&sink, (size_t)width);
    disti_put_text(&sink, " ");
    disti_put_size(&sink, (size_t)height);
    disti_put_text(&sink, "\n-1.0\n"); /* negative: little-endian */
    *size = sink.size + 4 * floats;
    if (!buffer) return DIST_OK;
    if (!pixels) return disti_refuse(ctx, "%s: pixels is NULL", name);
    if (capacity < *size) return disti_capacity(ctx, name, capacity, *size);
    memcpy(buffer, header, sink.size);
    sink.out = (unsigned char *)buffer;
    size_t row = (size_t)width * (size_t)channels;
    for (size_t y = (size_t)height; y-- > 0;)
        for (size_t i = 0; i < row; i++) disti_put_float(&sink, pixels[y * row + i]);
    return DIST_OK;
}

typedef struct disti_pfm {
    int width, height, channels, big_endian;
    size_t floats;
    const unsigned char *data; /* bottom row first */
} disti_pfm;

/* label: what to call the file in a sentence. All of the picture is there when this succeeds. */
static dist_status disti_pfm_parse(dist_context *ctx, const char *label, const void *bytes, size_t size, disti_pfm *pfm)
{
    disti_text t;
    int64_t side[2];
    double scale = 0.0;
    memset(pfm, 0, sizeof *pfm);
    t.at = (const char *)bytes;
    t.end = t.at + size;
    if (size < 3 || t.at[0] != 'P' || (t.at[1] != 'f' && t.at[1] != 'F') || !disti_is_space(t.at[2]))
        return disti_fail(ctx, DIST_BAD_FILE, "dist_pfm_read (%s): not a PFM file, must begin with Pf or PF", label, 0,
                          0);
    pfm->channels = t.at[1] == 'F' ? 3 : 1;
    t.at += 2;
    for (int i = 0; i < 2; i++) {
        disti_skip_space(&t);
        if (!disti_text_integer(&t, side + i) || side[i] < 1 || side[i] > 0x7fffffff || t.at == t.end ||
            !disti_is_space(*t.at))
            return disti_fail(ctx, DIST_BAD_FILE,
                              "dist_pfm_read (%s): width or height is no number from 1 to 2147483647", label, 0, 0);
    }
    disti_skip_space(&t);
    if (!disti_text_number(&t, &scale) || !(scale < 0.0 || scale > 0.0) || t.at == t.end || !disti_is_space(*t.at))
        return disti_fail(ctx, DIST_BAD_FILE, "dist_pfm_read (%s): the scale is not a number other than 0", label, 0,
                          0);
    pfm->width = (int)side[0];
    pfm->height = (int)side[1];
    pfm->big_endian = scale > 0.0;
    size_t left = (size_t)(t.end - t.at) - 1, need;
    if (!disti_size_mul((size_t)side[0], (size_t)side[1], &pfm->floats) ||
        !disti_size_mul(pfm->floats, (size_t)pfm->channels, &pfm->floats) || !disti_size_mul(pfm->floats, 4, &need) ||
        need > left)
        return disti_fail(ctx, DIST_BAD_FILE, "dist_pfm_read (%s): truncated, %d of %d bytes of pixels are there",
                          label, (double)left, (double)side[0] * (double)side[1] * (4.0 * pfm->channels));
    /* one white space ends the header; a line end behind it is the picture's first byte unless there is one to spare */
    int pair = t.at[0] != '\n' && left > need && t.at[1] == '\n';
    const unsigned char *first = (const unsigned char *)bytes;
    pfm->data = first + (t.at - (const char *)bytes) + (pair ? 2 : 1);
    return DIST_OK;
}

static void disti_pfm_give(const disti_pfm *pfm, int *width, int *height, int *channels, float *pixels)
{
    *width = pfm->width;
    *height = pfm->height;
    *channels = pfm->channels;
    if (!pixels) return;
    size_t row = (size_t)pfm->width * (size_t)pfm->channels;
    const unsigned char *in = pfm->data;
    for (size_t y = (size_t)pfm->height; y-- > 0;)
        for (size_t i = 0; i < row; i++, in += 4) {
            uint32_t bits = 0;
            for (int k = 0; k < 4; k++) bits |= (uint32_t)in[k] << 8 * (pfm->big_endian ? 3 - k : k);
            memcpy(pixels + y * row + i, &bits, sizeof bits);
        }
}

DIST_API dist_status dist_pfm_read(dist_context *ctx, const void *bytes, size_t size, int *width, int *height,
                                   int *channels, float *pixels, size_t capacity)
{
    disti_pfm pfm;
    dist_status status = disti_enter(ctx, "dist_pfm_read");
    if (status != DIST_OK) return status;
    if (!bytes || !width || !height || !channels)
        return disti_refuse(ctx, "dist_pfm_read: %s is NULL", bytes ? "width, height or channels" : "bytes");
    status = disti_pfm_parse(ctx, "in memory", bytes, size, &pfm);
    if (status != DIST_OK) return status;
    if (pixels && capacity < pfm.floats) return disti_capacity(ctx, "dist_pfm_read", capacity, pfm.floats);
    disti_pfm_give(&pfm, width, height, channels, pixels);
    return DIST_OK;
}

DIST_API void dist_pfm_free(dist_context *ctx, float *pixels, int width, int height, int channels)
{
    if (ctx && pixels) disti_free(ctx, pixels, (size_t)width * (size_t)height * (size_t)channels * sizeof(float));
}

#ifndef DIST_NO_STDIO
DIST_API dist_status dist_pfm_save(dist_context *ctx, const char *path, int width, int height, int channels,
                                   const float *pixels)
{
    size_t size = 0;
    dist_status status = dist_pfm_write(ctx, width, height, channels, pixels, NULL, 0, &size);
    if (status != DIST_OK) return status;
    if (!path || !pixels) return disti_refuse(ctx, "dist_pfm_save: %s is NULL", path ? "pixels" : "path");
    ctx->function = "dist_pfm_save";
    void *bytes = disti_alloc(ctx, size);
    if (bytes) status = dist_pfm_write(ctx, width, height, channels, pixels, bytes, size, &size);
    return disti_file_write(ctx, "dist_pfm_save", path, bytes, size, status);
}

DIST_API float *dist_pfm_load(dist_context *ctx, const char *path, int *width, int *height, int *channels)
{
    const char *name = "dist_pfm_load";
    disti_pfm pfm;
    float *pixels = NULL;
    size_t size = 0;
    if (disti_enter(ctx, name) != DIST_OK) return NULL;
    if (!path || !width || !height || !channels) {
        disti_refuse(ctx, "%s: path, width, height or channels is NULL", name);
        return NULL;
    }
    unsigned char *bytes = disti_file_read(ctx, name, path, &size);
    if (!bytes) return NULL;
    if (disti_pfm_parse(ctx, path, bytes, size, &pfm) == DIST_OK)
        pixels = (float *)disti_alloc(ctx, pfm.floats * sizeof(float)); /* fits: as many bytes are in the file */
    if (pixels) disti_pfm_give(&pfm, width, height, channels, pixels);
    disti_free(ctx, bytes, size);
    return pixels;
}
#endif

#ifndef DIST_NO_MESH
/* Lines end with LF, CR LF or CR. */
static int disti_is_line_end(char c)
{
    return c == '\n' || c == '\r';
}

static int disti_is_blank(char c)
{
    return disti_is_space(c) && !disti_is_line_end(c);
}

static void disti_skip_blank(disti_text *t)
{
    while (t->at < t->end && disti_is_blank(*t->at)) t->at++;
}

static void disti_skip_line(disti_text *t)
{
    while (t->at < t->end && !disti_is_line_end(*t->at)) t->at++;
    if (t->end - t->at > 1 && t->at[0] == '\r' && t->at[1] == '\n') t->at++;
    if (t->at < t->end) t->at++;
}

/* Float to double and back by the bits: a program that flushes denormals would lose them. */
static double disti_widen(uint32_t bits)
{
    float x;
    memcpy(&x, &bits, sizeof x);
    if (bits & 0x7f800000u) return (double)x;
    double tiny = (double)(bits & 0x7fffffu) * 1.40129846432481707e-45;
    return bits >> 31 ? -tiny : tiny;
}

static float disti_narrow(double x)
{
    const double largest = 340282346638528859811704183484516925440.0; /* nine digits of it are a little more */
    uint64_t wide;
    float result = (float)DISTI_MAX(DISTI_MIN(x, largest), -largest);
    memcpy(&wide, &x, sizeof wide);
    if (fabs(x) >= 1.17549435e-38) return result;
    uint32_t bits = (uint32_t)(fabs(x) / 1.40129846432481707e-45 + 0.5) | (uint32_t)(wide >> 63 << 31);
    memcpy(&result, &bits, sizeof result);
    return result;
}

/* A mesh file while it is read. Counts in it are never believed: every vertex and corner is read before there is
   memory for it, so that memory stays within a small multiple of the file. All functions return 1, or 0 after
   disti_fail. */
typedef struct disti_mesh_text {
    disti_text text;
    const char *begin;
    const char *label; /* what to call the file in a sentence */
    dist_mesh *mesh;
    unsigned first, last; /* corners of the polygon that is read: it is fanned from the first */
} disti_mesh_text;

/* what: a sentence in which %d is number. */
static int disti_mesh_fail(const disti_mesh_text *r, dist_status status, const char *what, double number)
{
    char format[160] = "dist_mesh_read (%s): byte %d: ";
    size_t n = strlen(format);
    while (*what && n + 1 < sizeof format) format[n++] = *what++;
    format[n] = 0;
    disti_fail(r->mesh->owner, status, format, r->label, (double)(r->text.at - r->begin), number);
    return 0;
}

static int disti_mesh_read_vertex(disti_mesh_text *r, const double v[3])
{
    float p[3];
    for (int k = 0; k < 3; k++) {
        if (!disti_finite_double(v[k]) || fabs(v[k]) > 3.4028235e38)
            return disti_mesh_fail(r, DIST_NOT_FINITE, "vertex %d is not finite", (double)r->mesh->vertex_count);
        p[k] = disti_narrow(v[k]);
    }
    return disti_mesh_add_vertex(r->mesh, p);
}

/* Corner number k of a polygon. A polygon of one or two corners adds nothing. */
static int disti_mesh_read_corner(disti_mesh_text *r, size_t k, double index)
{
    if (!(index >= 0.0 && index < 4294967295.0) || index != (double)(unsigned)index)
        return disti_mesh_fail(r, DIST_BAD_FILE, "a face has vertex %d, which is out of range", index);
    unsigned corner = (unsigned)index;
    if (k == 0) r->first = corner;
    if (k >= 2 && !disti_mesh_add_triangle(r->mesh, r->first, r->last, corner)) return 0;
    r->last = corner;
    return 1;
}

/* A line of OBJ goes on after a backslash at its end. */
static void disti_skip_blank_obj(disti_text *t)
{
    disti_skip_blank(t);
    while (t->end - t->at > 1 && t->at[0] == '\\' && disti_is_line_end(t->at[1])) {
        disti_skip_line(t);
        disti_skip_blank(t);
    }
}

static int disti_obj_word_ends(const disti_text *t)
{
    return t->at >= t->end || *t->at == '\\' || *t->at == '#' || disti_is_space(*t->at);
}

/* Without vertices: what disti_write_obj makes of an empty mesh, a comment and nothing else. */
static int disti_read_obj(disti_mesh_text *r)
{
    disti_text *t = &r->text;
    int comment = 0, other = 0;
    for (; t->at < t->end; disti_skip_line(t)) {
        disti_skip_blank(t);
        if (t->at < t->end && *t->at == '#') comment = 1;
        else if (t->at < t->end && !disti_is_space(*t->at)) other = 1;
        if (t->end - t->at < 2 || !disti_is_blank(t->at[1]) || (t->at[0] != 'v' && t->at[0] != 'f')) continue;
        int face = *t->at++ == 'f';
        double v[3];
        for (int k = 0; !face && k < 3; k++) {
            disti_skip_blank_obj(t);
            if (!disti_text_number(t, v + k) || !disti_obj_word_ends(t))
                return disti_mesh_fail(r, DIST_BAD_FILE, "a vertex must be three numbers", 0);
        }
        if (!face && !disti_mesh_read_vertex(r, v)) return 0;
        for (size_t k = 0; face; k++) {
            int64_t i = 0;
            disti_skip_blank_obj(t);
            if (t->at == t->end || disti_is_line_end(*t->at) || *t->at == '#') break;
            if (!disti_text_integer(t, &i) || (!disti_obj_word_ends(t) && *t->at != '/'))
                return disti_mesh_fail(r, DIST_BAD_FILE, "not a corner of a face", 0);
            if (i == 0 || i + (int64_t)r->mesh->vertex_count < 0)
                return disti_mesh_fail(r, DIST_BAD_FILE, "a face has vertex %d, must count from 1, or back from -1 to "
                                                         "what stands before it", (double)i);
            while (!disti_obj_word_ends(t)) t->at++; /* texture and normal */
            if (!disti_mesh_read_corner(r, k, (double)(i > 0 ? i - 1 : i + (int64_t)r->mesh->vertex_count))) return 0;
        }
    }
    if (r->mesh->vertex_count || (comment && !other)) return 1;
    return disti_mesh_fail(r, DIST_BAD_FILE, "neither PLY nor OFF nor an OBJ with vertices", 0);
}

/* The next number, over line ends and comments. */
static int disti_off_number(disti_mesh_text *r, double *out)
{
    disti_text *t = &r->text;
    for (disti_skip_space(t); t->at < t->end && *t->at == '#'; disti_skip_space(t)) disti_skip_line(t);
    if (disti_text_number(t, out)) return 1;
    return disti_mesh_fail(r, DIST_BAD_FILE, "truncated, or not a number", 0);
}

static int disti_off_line_ends(const disti_text *t)
{
    return t->at >= t->end || *t->at == '#' || disti_is_line_end(*t->at);
}

/* 0 after disti_fail where a count in the file is none. */
static int disti_mesh_read_count(disti_mesh_text *r, double count)
{
    if (count >= 0.0 && count < 4294967296.0 && count == floor(count)) return 1;
    return disti_mesh_fail(r, DIST_BAD_FILE, "%d is no count, must be a whole number from 0 to 4294967295", count);
}

/* What follows the numbers on a line (normals, colors) is left out. The number of edges may be missing. */
static int disti_read_off(disti_mesh_text *r)
{
    double counts[2], v[3], corners, index;
    disti_skip_blank(&r->text);
    if (r->text.end - r->text.at >= 6 && memcmp(r->text.at, "BINARY", 6) == 0)
        return disti_mesh_fail(r, DIST_UNSUPPORTED, "binary OFF is not supported", 0);
    for (int i = 0; i < 2; i++)
        if (!disti_off_number(r, counts + i) || !disti_mesh_read_count(r, counts[i])) return 0;
    disti_skip_blank(&r->text);
    int ends = disti_off_line_ends(&r->text);
    disti_skip_line(&r->text);
    if (ends && counts[0] > 0.0) { /* is the number of edges by itself on the next line? */
        disti_text next = r->text;
        if (!disti_off_number(r, v)) return 0;
        disti_skip_blank(&r->text);
        if (!disti_off_line_ends(&r->text)) r->text = next;
    }
    for (double i = 0.0; i < counts[0]; i += 1.0) {
        for (int k = 0; k < 3; k++)
            if (!disti_off_number(r, v + k)) return 0;
        if (!disti_mesh_read_vertex(r, v)) return 0;
        disti_skip_line(&r->text);
    }
    for (double i = 0.0; i < counts[1]; i += 1.0) {
        if (!disti_off_number(r, &corners) || !disti_mesh_read_count(r, corners)) return 0;
        for (size_t k = 0; (double)k < corners; k++)
            if (!disti_off_number(r, &index) || !disti_mesh_read_corner(r, k, index)) return 0;
        disti_skip_line(&r->text);
    }
    return 1;
}

enum { DISTI_PLY_X = 0, DISTI_PLY_INDICES = 3, DISTI_PLY_OTHER = 4 };
enum { DISTI_PLY_ELEMENTS = 16, DISTI_PLY_PROPERTIES = 128 };

typedef struct disti_ply_property {
    int type;       /* 0 int8, uint8, int16, uint16, int32, uint32, float32, 7 float64 */
    int count_type; /* -1: not a list */
    int role;       /* DISTI_PLY_X + axis, ... */
} disti_ply_property;

typedef struct disti_ply_element {
    int64_t count;
    int vertex, face, first, last; /* properties first..last-1 */
} disti_ply_element;

typedef struct disti_ply {
    int has_format, ascii, big_endian, element_count, property_count;
    disti_ply_element elements[DISTI_PLY_ELEMENTS];
    disti_ply_property properties[DISTI_PLY_PROPERTIES];
} disti_ply;

/* Steps over the word if it is the next one on the line. */
static int disti_ply_word(disti_text *t, const char *word)
{
    size_t n = strlen(word);
    disti_skip_blank(t);
    if ((size_t)(t->end - t->at) <= n || memcmp(t->at, word, n) != 0 || !disti_is_space(t->at[n])) return 0;
    t->at += n;
    return 1;
}

static int disti_ply_type(disti_text *t)
{
    static const char names[16][8] = {"char", "int8", "uchar", "uint8", "short", "int16", "ushort", "uint16",
                                          "int", "int32", "uint", "uint32", "float", "float32", "double", "float64"};
    for (int i = 0; i < 16; i++)
        if (disti_ply_word(t, names[i])) return i / 2;
    return -1;
}

static int disti_ply_property_line(disti_mesh_text *r, disti_ply *ply)
{
    disti_text *t = &r->text;
    if (ply->element_count == 0 || ply->property_count == DISTI_PLY_PROPERTIES)
        return disti_mesh_fail(r, DIST_UNSUPPORTED, "a PLY property without an element, or the 129th", 0);
    disti_ply_element *element = ply->elements + ply->element_count - 1;
    disti_ply_property *p = ply->properties + ply->property_count++;
    int list = disti_ply_word(t, "list");
    p->count_type = list ? disti_ply_type(t) : -1;
    p->type = disti_ply_type(t);
    p->role = DISTI_PLY_OTHER;
    if (p->type < 0 || (list && (p->count_type < 0 || p->count_type > 5)))
        return disti_mesh_fail(r, DIST_BAD_FILE, "not a type of a PLY property", 0);
    const char *axes[3] = {"x", "y", "z"};
    for (int k = 0; !list && element->vertex && k < 3; k++)
        if (disti_ply_word(t, axes[k])) p->role = DISTI_PLY_X + k;
    if (list && element->face && (disti_ply_word(t, "vertex_indices") || disti_ply_word(t, "vertex_index")))
        p->role = DISTI_PLY_INDICES;
    element->last = ply->property_count;
    return 1;
}

static int disti_ply_element_line(disti_mesh_text *r, disti_ply *ply)
{
    disti_text *t = &r->text;
    disti_ply_element *element = ply->elements + ply->element_count;
    if (ply->element_count == DISTI_PLY_ELEMENTS)
        return disti_mesh_fail(r, DIST_UNSUPPORTED, "more than 16 PLY elements", 0);
    ply->element_count++;
    element->vertex = disti_ply_word(t, "vertex");
    element->face = disti_ply_word(t, "face");
    if (disti_ply_word(t, "tristrips"))
        return disti_mesh_fail(r, DIST_UNSUPPORTED, "strips of triangles (PLY tristrips); faces are read", 0);
    element->first = element->last = ply->property_count;
    disti_skip_blank(t);
    while (t->at < t->end && !element->vertex && !element->face && !disti_is_space(*t->at)) t->at++;
    disti_skip_blank(t);
    if (disti_text_integer(t, &element->count) && element->count >= 0) return 1;
    return disti_mesh_fail(r, DIST_BAD_FILE, "not the count of a PLY element", 0);
}

static int disti_ply_header(disti_mesh_text *r, disti_ply *ply)
{
    disti_text *t = &r->text;
    memset(ply, 0, sizeof *ply);
    for (disti_skip_line(t); t->at < t->end; disti_skip_line(t)) {
        if (disti_ply_word(t, "end_header")) {
            disti_skip_line(t);
            return ply->has_format ? 1 : disti_mesh_fail(r, DIST_BAD_FILE, "the PLY header has no format", 0);
        } else if (disti_ply_word(t, "format")) {
            ply->has_format = 1;
            ply->ascii = disti_ply_word(t, "ascii");
            ply->big_endian = disti_ply_word(t, "binary_big_endian");
            if (!ply->ascii && !ply->big_endian && !disti_ply_word(t, "binary_little_endian"))
                return disti_mesh_fail(r, DIST_BAD_FILE, "the PLY format is none of ascii, binary_little_endian and "
                                                         "binary_big_endian", 0);
        } else if (disti_ply_word(t, "element")) {
            if (!disti_ply_element_line(r, ply)) return 0;
        } else if (disti_ply_word(t, "property")) {
            if (!disti_ply_property_line(r, ply)) return 0;
        }
    }
    return disti_mesh_fail(r, DIST_BAD_FILE, "the PLY header has no end", 0);
}

static int disti_ply_value(disti_mesh_text *r, const disti_ply *ply, int type, double *out)
{
    static const unsigned char sizes[8] = {1, 1, 2, 2, 4, 4, 4, 8};
    disti_text *t = &r->text;
    uint64_t bits = 0;
    *out = 0.0;
    if (ply->ascii) {
        disti_skip_space(t);
        if (disti_text_number(t, out) && (t->at == t->end || disti_is_space(*t->at))) return 1;
        return disti_mesh_fail(r, DIST_BAD_FILE, "truncated, or not a finite number", 0);
    }
    if (t->end - t->at < sizes[type])
        return disti_mesh_fail(r, DIST_BAD_FILE, "truncated", 0);
    for (int i = 0, last = sizes[type] - 1; i <= last; i++)
        bits |= (uint64_t)(unsigned char)*t->at++ << 8 * (ply->big_endian ? last - i : i);
    uint32_t low = (uint32_t)(bits & 0xffffffffu);
    uint64_t sign = (uint64_t)1 << (8 * sizes[type] - 1);
    if (type == 7) memcpy(out, &bits, sizeof bits);
    else if (type == 6) *out = disti_widen(low);
    else *out = (double)bits - ((type & 1) == 0 && (bits & sign) ? 2.0 * (double)sign : 0.0);
    return 1;
}

/* A value nobody wants: in text it may be anything, such as nan. */
static int disti_ply_skip(disti_mesh_text *r, const disti_ply *ply, int type)
{
    double ignored;
    if (!ply->ascii) return disti_ply_value(r, ply, type, &ignored);
    disti_skip_space(&r->text);
    if (r->text.at == r->text.end)
        return disti_mesh_fail(r, DIST_BAD_FILE, "truncated", 0);
    while (r->text.at < r->text.end && !disti_is_space(*r->text.at)) r->text.at++;
    return 1;
}

/* One vertex, one face or one of what is left out. */
static int disti_ply_item(disti_mesh_text *r, const disti_ply *ply, const disti_ply_element *element)
{
    double v[3], value, count;
    for (int i = element->first; i < element->last; i++) {
        const disti_ply_property *p = ply->properties + i;
        if (p->count_type < 0) {
            if (p->role > 2 ? !disti_ply_skip(r, ply, p->type) : !disti_ply_value(r, ply, p->type, v + p->role))
                return 0;
            continue;
        }
        if (!disti_ply_value(r, ply, p->count_type, &count) || !disti_mesh_read_count(r, count)) return 0;
        for (size_t k = 0; (double)k < count; k++) {
            if (p->role != DISTI_PLY_INDICES) {
                if (!disti_ply_skip(r, ply, p->type)) return 0;
            } else if (!disti_ply_value(r, ply, p->type, &value) || !disti_mesh_read_corner(r, k, value)) {
                return 0;
            }
        }
    }
    return element->vertex ? disti_mesh_read_vertex(r, v) : 1;
}

static int disti_read_ply(disti_mesh_text *r)
{
    disti_ply ply;
    if (!disti_ply_header(r, &ply)) return 0;
    for (int e = 0; e < ply.element_count; e++) {
        const disti_ply_element *element = ply.elements + e;
        int roles = 0;
        for (int i = element->first; i < element->last; i++) roles |= 1 << ply.properties[i].role;
        if (element->vertex && (roles & 7) != 7)
            return disti_mesh_fail(r, DIST_BAD_FILE, "the PLY vertices have no x, y and z", 0);
        if (element->face && element->count > 0 && !(roles >> DISTI_PLY_INDICES & 1))
            return disti_mesh_fail(r, DIST_BAD_FILE, "the PLY faces have no list vertex_indices", 0);
        if (roles == 0) continue; /* no properties: no bytes, whatever the count says */
        for (int64_t i = 0; i < element->count; i++)
            if (!disti_ply_item(r, &ply, element)) return 0;
    }
    return 1;
}

static dist_mesh *disti_mesh_parse(dist_context *ctx, const char *label, const void *bytes, size_t size)
{
    disti_mesh_text r;
    memset(&r, 0, sizeof r);
    r.begin = r.text.at = (const char *)bytes;
    r.text.end = r.begin + size;
    r.label = label;
    r.mesh = disti_mesh_new(ctx);
    if (!r.mesh) return NULL;
    int good, obj = 0;
    if (size > 3 && memcmp(bytes, "\357\273\277", 3) == 0) r.text.at += 3; /* some editors mark UTF-8 so */
    const char *text = r.text.at;
    size = (size_t)(r.text.end - text);
    if (size > 4 && memcmp(text, "ply", 3) == 0 && disti_is_space(text[3])) {
        good = disti_read_ply(&r);
    } else {
        disti_text peek = r.text;
        for (disti_skip_space(&peek); peek.at < peek.end && *peek.at == '#'; disti_skip_space(&peek))
            disti_skip_line(&peek);
        text = peek.at;
        size = (size_t)(peek.end - text);
        size_t prefix = size > 4 && text[0] == 'S' && text[1] == 'T' ? 2 : 0; /* of textures; C: colors, N: normals */
        prefix += size > 4 + prefix && text[prefix] == 'C';
        prefix += size > 4 + prefix && text[prefix] == 'N';
        int off = size > 3 + prefix && memcmp(text + prefix, "OFF", 3) == 0;
        if (off) { /* ModelNet's files may have the first count at the word: OFF490 518 0 */
            char next = text[prefix + 3];
            off = disti_is_space(next) || (next >= '0' && next <= '9');
        }
        if (off) r.text.at = text + prefix + 3;
        obj = !off;
        size_t at = 0;
        while (at < size && disti_is_space(text[at])) at++;
        if (obj && at < size && text[at] != '#' && !(text[at] >= 'a' && text[at] <= 'z')) /* as all lines begin */
            good = disti_mesh_fail(&r, DIST_BAD_FILE, "this is no PLY, OBJ or OFF file", 0);
        else
            good = off ? disti_read_off(&r) : disti_read_obj(&r);
    }
    const char *format = obj ? "dist_mesh_read (%s): a face has vertex %d, must be 1 to %d"
                             : "dist_mesh_read (%s): a face has vertex %d, must be below %d";
    if (good && disti_mesh_check(ctx, r.mesh, DIST_BAD_FILE, format, label, obj)) return r.mesh;
    dist_mesh_destroy(r.mesh);
    return NULL;
}

DIST_API dist_mesh *dist_mesh_read(dist_context *ctx, const void *bytes, size_t size)
{
    if (disti_enter(ctx, "dist_mesh_read") != DIST_OK) return NULL;
    if (bytes) return disti_mesh_parse(ctx, "in memory", bytes, size);
    disti_refuse(ctx, "dist_mesh_read: bytes is NULL", NULL);
    return NULL;
}

/* Nine significant digits bring every float back. */
static void disti_sink_decimal(disti_writer *sink, float number)
{
    uint32_t bits;
    memcpy(&bits, &number, sizeof bits);
    disti_put_number(sink, disti_widen(bits), 9);
}

static void disti_write_ply(disti_writer *sink, const dist_mesh *mesh)
{
    disti_put_text(sink, "ply\nformat binary_little_endian 1.0\nelement vertex ");
    disti_put_size(sink, mesh->vertex_count);
    disti_put_text(sink, "\nproperty float x\nproperty float y\nproperty float z\n");
    if (mesh->normals) disti_put_text(sink, "property float nx\nproperty float ny\nproperty float nz\n");
    disti_put_text(sink, "element face ");
    disti_put_size(sink, mesh->triangle_count);
    /* some programs read only int; uint where it is needed */
    disti_put_text(sink,
                    mesh->vertex_count > 0x7fffffffu ? "\nproperty list uchar uint" : "\nproperty list uchar int");
    disti_put_text(sink, " vertex_indices\nend_header\n");
    for (size_t i = 0; i < mesh->vertex_count; i++) {
        for (size_t k = 0; k < 3; k++) disti_put_float(sink, mesh->vertices[3 * i + k]);
        for (size_t k = 0; mesh->normals && k < 3; k++) disti_put_float(sink, mesh->normals[3 * i + k]);
    }
    for (size_t i = 0; i < mesh->triangle_count; i++) {
        disti_put(sink, "\003", 1);
        for (size_t k = 0; k < 3; k++) disti_put_word(sink, mesh->triangles[3 * i + k]);
    }
}

static void disti_write_obj_vectors(disti_writer *sink, const char *letter, size_t n, const float *vectors)
{
    for (size_t i = 0; i < n; i++) {
        disti_put_text(sink, letter);
        for (size_t k = 0; k < 3; k++) {
            disti_put_text(sink, " ");
            disti_sink_decimal(sink, vectors[3 * i + k]);
        }
        disti_put_text(sink, "\n");
    }
}

static void disti_write_obj(disti_writer *sink, const dist_mesh *mesh)
{
    if (!mesh->vertex_count) disti_put_text(sink, "# no surface\n");
    disti_write_obj_vectors(sink, "v", mesh->vertex_count, mesh->vertices);
    if (mesh->normals) disti_write_obj_vectors(sink, "vn", mesh->vertex_count, mesh->normals);
    for (size_t i = 0; i < mesh->triangle_count; i++) {
        disti_put_text(sink, "f");
        for (size_t k = 0; k < 3; k++) {
            disti_put_text(sink, " ");
            disti_put_size(sink, (size_t)mesh->triangles[3 * i + k] + 1);
            if (!mesh->normals) continue;
            disti_put_text(sink, "//");
            disti_put_size(sink, (size_t)mesh->triangles[3 * i + k] + 1);
        }
        disti_put_text(sink, "\n");
    }
}

DIST_API dist_status dist_mesh_write(dist_context *ctx, const dist_mesh *mesh, int format, void *buffer,
                                     size_t capacity, size_t *size)
{
    const char *name = "dist_mesh_write";
    disti_writer sink = {NULL, 0};
    dist_status status = disti_enter(ctx, name);
    if (status != DIST_OK) return status;
    if (!mesh || !size) return disti_refuse(ctx, "dist_mesh_write: %s is NULL", mesh ? "size" : "mesh");
    if (format != DIST_MESH_PLY && format != DIST_MESH_OBJ)
        return disti_fail(ctx, DIST_BAD_ARGUMENT, "%s: format is %d, must be DIST_MESH_PLY or DIST_MESH_OBJ", name,
                          format, 0);
    if (!disti_mesh_whole(ctx, name, mesh)) return DIST_BAD_ARGUMENT;
    for (size_t i = 0; i < mesh->vertex_count; i++)
        if (!disti_finite_all(3, mesh->vertices + 3 * i) ||
            (mesh->normals && !disti_finite_all(3, mesh->normals + 3 * i)))
            return disti_fail(ctx, DIST_NOT_FINITE, "%s: vertex %d is not finite", name, (double)i, 0);
    if (!disti_mesh_check(ctx, mesh, DIST_BAD_ARGUMENT, "%s: a triangle has vertex %d, must be below %d", name, 0))
        return DIST_BAD_ARGUMENT;
    for (int pass = 0; pass < 2; pass++) { /* counts, then writes */
        if (format == DIST_MESH_PLY) disti_write_ply(&sink, mesh);
        else disti_write_obj(&sink, mesh);
        *size = sink.size;
        if (!buffer) return DIST_OK;
        if (capacity < *size) return disti_capacity(ctx, name, capacity, *size);
        sink.out = (unsigned char *)buffer;
        sink.size = 0;
    }
    return DIST_OK;
}

#ifndef DIST_NO_STDIO
DIST_API dist_mesh *dist_mesh_load(dist_context *ctx, const char *path)
{
    size_t size;
    if (disti_enter(ctx, "dist_mesh_load") != DIST_OK) return NULL;
    unsigned char *bytes = disti_file_read(ctx, "dist_mesh_load", path, &size);
    dist_mesh *mesh = bytes ? disti_mesh_parse(ctx, path, bytes, size) : NULL;
    disti_free(ctx, bytes, size);
    return mesh;
}

DIST_API dist_status dist_mesh_save(dist_context *ctx, const dist_mesh *mesh, const char *path)
{
    size_t size = 0, n = path ? strlen(path) : 0;
    dist_status status = disti_enter(ctx, "dist_mesh_save");
    if (status != DIST_OK) return status;
    if (!mesh || !path) return disti_refuse(ctx, "dist_mesh_save: %s is NULL", mesh ? "path" : "mesh");
    int ply = n >= 4 && (memcmp(path + n - 4, ".ply", 4) == 0 || memcmp(path + n - 4, ".PLY", 4) == 0);
    int obj = n >= 4 && (memcmp(path + n - 4, ".obj", 4) == 0 || memcmp(path + n - 4, ".OBJ", 4) == 0);
    if (!ply && !obj) return disti_refuse(ctx, "dist_mesh_save: path is '%s', must end in .ply or .obj", path);
    int format = ply ? DIST_MESH_PLY : DIST_MESH_OBJ;
    status = dist_mesh_write(ctx, mesh, format, NULL, 0, &size);
    if (status != DIST_OK) return status;
    ctx->function = "dist_mesh_save";
    void *bytes = disti_alloc(ctx, size);
    if (bytes) status = dist_mesh_write(ctx, mesh, format, bytes, size, &size);
    return disti_file_write(ctx, "dist_mesh_save", path, bytes, size, status);
}
#endif
#endif

/*@ 13 workspace ---------------------------------------------------------------------------------------------------- */

/* What dist_workspace_bytes hands to the create functions' own code: it adds up what is asked for and gives an address
   that is never read. Only an archive's table of contents, which is read, comes from a real allocator. */
typedef struct disti_measure {
    size_t bytes;
    int real; /* the next requests are passed on */
    dist_allocator allocator;
    unsigned char place[DISTI_ALIGNMENT]; /* its aligned address is the one that is given */
} disti_measure;

static void *disti_measure_place(disti_measure *m)
{
    return m->place + (DISTI_ALIGNMENT - (uintptr_t)m->place % DISTI_ALIGNMENT) % DISTI_ALIGNMENT;
}

static void *disti_measure_alloc(void *user, size_t bytes, size_t alignment)
{
    disti_measure *m = (disti_measure *)user;
    size_t whole;
    if (!disti_size_add(bytes, DISTI_ALIGNMENT - 1, &whole) ||
        !disti_size_add(m->bytes, whole & ~(size_t)(DISTI_ALIGNMENT - 1), &m->bytes))
        return NULL;
    if (!m->real) return disti_measure_place(m);
    return m->allocator.alloc_fn ? m->allocator.alloc_fn(m->allocator.user, bytes, alignment) : NULL;
}

static void disti_measure_free(void *user, void *pointer, size_t bytes)
{
    disti_measure *m = (disti_measure *)user;
    if (pointer != disti_measure_place(m)) m->allocator.free_fn(m->allocator.user, pointer, bytes);
}

/* As dist_net_load, without numbers. */
static dist_status disti_measure_net(dist_context *ctx, disti_measure *m, const void *bytes, size_t size, dist_net *net)
{
    disti_loader loader;
    m->real = 1;
    dist_status status = disti_loader_open(&loader, ctx, bytes, size);
    m->real = 0;
    if (status != DIST_OK) return status;
    disti_alloc(ctx, sizeof *net);
    disti_net_begin(ctx, net);
    loader.net = net;
    status = disti_loader_arrange(&loader);
    disti_archive_close(ctx, &loader.archive);
    return status;
}

/* Its shapes and scene. net and texture may be NULL. */
static dist_status disti_measure_shapes(dist_context *ctx, const dist_net *net, const dist_net *texture, int shapes,
                                        int instances)
{
    dist_shape shape, paint;
    dist_scene scene;
    dist_status status = DIST_OK;
    for (int i = 0; net && i < shapes && status == DIST_OK; i++) {
        memset(&shape, 0, sizeof shape);
        disti_alloc(ctx, sizeof shape);
        shape.ctx = ctx;
        shape.net = net;
        status = disti_shape_take(&shape);
        if (!texture || status != DIST_OK) continue;
        paint = shape;
        disti_alloc(ctx, sizeof paint);
        paint.net = texture;
        shape.texture = &paint;
        status = disti_shape_take(&paint);
    }
    if (status != DIST_OK || instances == 0) return status;
    memset(&scene, 0, sizeof scene);
    disti_alloc(ctx, sizeof scene);
    scene.ctx = ctx;
    scene.count = instances;
    status = disti_scene_take(&scene);
    if (status != DIST_OK) return status;
    dist_field field = dist_shape_field(&shape);
    size_t codes, each = disti_field_code(&field) + 7 + (size_t)field.color_code_size;
    if (!field.eval_fn || !disti_size_mul((size_t)instances, each, &codes) || codes > 0x7fffffffu)
        return disti_refuse(ctx, "%s: the instances have no distance, or codes of more than 2^31 numbers in all",
                            "dist_workspace_bytes");
    return disti_partial_for(ctx, codes);
}

DIST_API size_t dist_workspace_bytes(const dist_workspace_desc *desc)
{
    dist_workspace_desc d;
    dist_context_desc context;
    dist_context ctx;
    dist_net net, texture;
    dist_tape tape;
    dist_cache cache;
    disti_measure m;
    dist_allocator counting = {&m, disti_measure_alloc, disti_measure_free};
    const char *name = "dist_workspace_bytes";
    memset(&d, 0, sizeof d);
    memset(&context, 0, sizeof context);
    memset(&m, 0, sizeof m);
    if (desc) d = *desc;
    if (d.context) context = *d.context;
    if (!disti_allocator_of(&context, &m.allocator)) {
        memset(&m.allocator, 0, sizeof m.allocator);
        if (context.allocator.alloc_fn || context.allocator.free_fn) {
            memset(&ctx, 0, sizeof ctx);
            ctx.logger = context.logger;
            disti_refuse(&ctx, "%s: context.allocator has one function of two", name);
            return 0;
        }
    }
    disti_measure_alloc(&m, sizeof ctx, DISTI_ALIGNMENT);
    dist_status status = disti_context_begin(&ctx, &context, &counting);
    ctx.function = name;
    if (status == DIST_OK && d.model) status = disti_measure_net(&ctx, &m, d.model, d.model_size, &net);
    if (status == DIST_OK && d.texture) status = disti_measure_net(&ctx, &m, d.texture, d.texture_size, &texture);
    if (status != DIST_OK) return 0;
    const dist_net *shaped = d.model ? &net : d.net, *colored = d.texture ? &texture : d.texture_net;
    if (!shaped && colored)
        status = disti_refuse(&ctx, "%s: a texture is given, but net and model are NULL", name);
    else if (d.shapes < 0 || d.shapes > 1 << 20 || d.instances < 0 || d.instances > 1 << 20 ||
        (!shaped && (d.shapes || d.instances)))
        status = disti_fail(&ctx, DIST_BAD_ARGUMENT,
                            "%s: shapes is %d, instances %d; must be 0 to 2^20, and 0 without a net", name,
                            d.shapes, d.instances);
    if (status == DIST_OK && colored) status = disti_texture_check(&ctx, shaped, colored);
    if (status == DIST_OK)
        status = disti_measure_shapes(&ctx, shaped, colored, d.shapes ? d.shapes : 1, d.instances);
    if (status == DIST_OK && d.camera) {
        status = disti_tape_check(&ctx, d.camera, d.how);
        disti_alloc(&ctx, sizeof tape);
        if (status == DIST_OK) status = disti_tape_take(&ctx, &tape, d.camera, d.how);
    }
    if (status == DIST_OK && d.cache) {
        disti_alloc(&ctx, sizeof cache);
        status = disti_cache_take(
            &ctx, d.cache, "%s: cache is %d, must be a multiple of 8 to 512 (0: none)", name, &cache);
    }
    return status == DIST_OK && m.bytes != (size_t)-1 ? m.bytes : 0;
}

#undef DISTI_RESTRICT
#undef DISTI_TARGET
#undef DISTI_UNUSED
#undef DISTI_KERNEL
#undef DISTI_LOOPS
#undef DISTI_INLINE
#undef DISTI_X86
#undef DISTI_HALF
#undef DISTI_NEON
#undef DISTI_OPENMP
#undef DISTI_ALIGNMENT
#undef DISTI_MIN
#undef DISTI_MAX
#undef DISTI_ANALYTIC
#undef DISTI_RADIUS_LEAST
#undef DISTI_RADIUS_MOST

#ifdef __cplusplus
}
#endif

#ifdef DISTI_WORDS
#define near
#define far
#undef DISTI_WORDS
#endif

#endif /* DIST_IMPLEMENTED */
#endif /* DIST_IMPLEMENTATION */

/* MIT No Attribution

   Copyright (c) The dist.h authors

   Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
   documentation files (the "Software"), to deal in the Software without restriction, including without limitation
   the rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and
   to permit persons to whom the Software is furnished to do so.

   THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
   WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
   COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
   OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE. */
