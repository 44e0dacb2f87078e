// Copies a depth texture to a float texture, number by number.
Shader "Hidden/CapSense/CopyDepth"
{
    Properties
    {
        _MainTex ("Depth", 2D) = "black" {}
    }
    SubShader
    {
        Pass
        {
            Cull Off ZWrite Off ZTest Always
            HLSLPROGRAM
            #pragma vertex vert
            #pragma fragment frag
            #include "UnityCG.cginc"

            sampler2D_float _MainTex;

            struct Corner
            {
                float4 position : SV_POSITION;
                float2 uv : TEXCOORD0;
            };

            Corner vert (float4 vertex : POSITION, float2 uv : TEXCOORD0)
            {
                Corner corner;
                corner.position = UnityObjectToClipPos(vertex);
                corner.uv = uv;
                return corner;
            }

            float4 frag (Corner corner) : SV_Target
            {
                return tex2D(_MainTex, corner.uv).r;
            }
            ENDHLSL
        }
    }
}
